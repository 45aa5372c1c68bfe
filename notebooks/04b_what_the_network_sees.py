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
# # What the network looks at
#
# **Does the network look where a person would?** Its score over the whole sphere of directions at one place, and the
# rendered views behind the peaks and the pits. The network has seen none of these images: it knows landmarks and poses.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import display

from wheretolook import load_scorer
from wheretolook.figures.peaks import peaks_figure
from wheretolook.notebook import open_release
from wheretolook.showcase import open_showcase
from wheretolook.showcase_figures import mistaken_location, peaks_of

# %%
release = open_release()
showcase = open_showcase(release, "apartment-210")
location = showcase.instructive_location()

# %% [markdown]
# ## The paper's network
#
# Numbers mark the highest scores among views that were labelled, letters the lowest, none within 40° of another of its
# kind. Rings localized within 5 cm and 0.4°, crosses did not. The peaks turn out to show shelves, chairs and a
# patterned carpet, the pits a bare ceiling. Below each view stands how far off the pose was that was found, if one was.

# %%
mlp = load_scorer(release.root / "weights" / "mlp-2d+z.safetensors", showcase.localization_map)
display(peaks_figure(*peaks_of(showcase, mlp, location).drawn))

# %% [markdown]
# ## The set network
#
# The scorer that ships also knows what each landmark is like: from where it was mapped, how often, how exactly. At the
# same place it tells better what fails: on the left of the sphere there are landmarks enough to please the paper's
# network, which only knows where they are, yet views do not localize.

# %%
scorer = load_scorer(release.root / "weights", showcase.localization_map)
display(peaks_figure(*peaks_of(showcase, scorer, location).drawn))

# %% [markdown]
# ## Where they err
#
# The place where the probabilities of the paper's network are farthest from what happened, of all at the height of
# eyes. Half of the sphere looks fine to it and fails.

# %%
mistaken = mistaken_location(showcase, mlp)
display(peaks_figure(*peaks_of(showcase, mlp, mistaken).drawn))

# %% [markdown]
# The set network at that place:

# %%
display(peaks_figure(*peaks_of(showcase, scorer, mistaken).drawn))
