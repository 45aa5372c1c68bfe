# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Input features of the network
#
# The network selects views before the camera turns, so its input is not an image but the projected landmarks of the
# map. This notebook follows one view from the pose to the 4,500 features of the paper's largest variant (Sec. 3.3) and
# through the network to its score.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import display

from wheretolook import load_scorer
from wheretolook_paper.figures.network import inputs_figure, learning_figure
from wheretolook_paper.release.mlp_architecture import architecture_table
from wheretolook_paper.release.notebook import open_release
from wheretolook_paper.release.showcase import learning_of, open_showcase

# %% [markdown]
# An apartment of the release, generated again from its seed, and the bundled version of the paper's network.

# %%
release = open_release()
showcase = open_showcase(release, "apartment-210")
location = showcase.instructive_location()

# %% [markdown]
# ## Landmarks, bins, channels
#
# Left, the highest-scored view at this location with its visible landmarks; below, their number in each of 30 × 30
# bins, light for many. Right, the three input variants: the mean pixel (*u*, *v*) of each bin, with depth *z*, or all
# three coordinates in the camera frame. The distant kitchen stands out in *z*.

# %%
mlp = load_scorer(showcase.localization_map, release.root / "weights" / "mlp-2d+z.safetensors")
learning = learning_of(showcase, mlp, location)
display(inputs_figure(learning.image))

# %% [markdown]
# ## A view with few landmarks
#
# From the same location towards the ceiling: the input is nearly empty.

# %%
worst = learning_of(showcase, mlp, location, best=False)
display(inputs_figure(worst.image))

# %% [markdown]
# ## Through the network
#
# The input is standardized by channel and passes two hidden layers of 300 units. Shown are the bundled network's actual
# activations for the two views above, with the pose error of the localized image below the score.

# %%
display(learning_figure(*learning))

# %% [markdown]
# The lowest-scored view at the same location:

# %%
display(learning_figure(*worst))

# %% [markdown]
# ## Architecture
#
# The paper's table of layers, read from the module.

# %%
architecture_table(mlp.network).style.format(thousands=",").hide(axis="index")
