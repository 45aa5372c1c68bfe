# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What the network is told
#
# **How does a view become an input?** Not as an image: a network that chooses views must answer before the camera has
# turned. It is told where the landmarks of the map would appear. This notebook follows one view from the pose to the
# 4,500 numbers of the paper's largest input (Sec. 3.3), and on through the network to its score.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import display

from wheretolook import load_scorer
from wheretolook_paper.figures.inputs import inputs_figure
from wheretolook_paper.figures.network_walkthrough import learning_figure
from wheretolook_paper.release.mlp_architecture import architecture_table
from wheretolook_paper.release.notebook import open_release
from wheretolook_paper.release.showcase import open_showcase
from wheretolook_paper.release.showcase_figures import learning_of

# %% [markdown]
# An apartment of the release, generated anew from its seed, and the paper's network that ships.

# %%
release = open_release()
showcase = open_showcase(release, "apartment-210")
location = showcase.instructive_location()

# %% [markdown]
# ## Landmarks, bins, channels
#
# Left, the view that the paper's network likes best at this place, as the camera would see it, with the landmarks in
# view; below, how many fall into each of 30 × 30 bins, dark for one, light for many. Right, what the three variants of
# the network are told of each bin: the mean pixel (*u*, *v*), the depth *z* as well, or all three coordinates in the
# camera's frame. The kitchen, far away, stands out in *z*.

# %%
mlp = load_scorer(release.root / "weights" / "mlp-2d+z.safetensors", showcase.localization_map)
learning = learning_of(showcase, mlp, location)
display(inputs_figure(learning.image))

# %% [markdown]
# ## A view with little to go by
#
# From the same place, towards the ceiling: next to nothing is left of the input.

# %%
worst = learning_of(showcase, mlp, location, best=False)
display(inputs_figure(worst.image))

# %% [markdown]
# ## Through the network
#
# The input is standardized by channel and goes through two hidden layers of 300 units. Nothing here is a cartoon: these
# are the values that the shipped network computes for the two views above. Below the score stands how far off the pose
# was when the image was localized.

# %%
display(learning_figure(*learning))

# %% [markdown]
# The view at the same place that it likes least:

# %%
display(learning_figure(*worst))

# %% [markdown]
# ## Its architecture
#
# The paper's table of layers, read off the module itself.

# %%
architecture_table(mlp.network).style.format(thousands=",").hide(axis="index")
