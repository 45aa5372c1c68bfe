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
# # Sampling viewpoints
#
# **Which viewpoints are worth asking about?** Locations are the centres of free voxels, directions a lattice on the
# sphere, and of these the ones are kept that see most landmarks. This notebook shows all three steps (paper, Sec. 3.1
# and 3.2) on a test apartment of the release.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import display

from wheretolook_paper.figures.lattices import fibonacci_figure
from wheretolook_paper.figures.sampling import sampling_figure
from wheretolook_paper.release.notebook import open_release
from wheretolook_paper.release.showcase import open_showcase
from wheretolook_paper.release.showcase_figures import sampling_of

# %% [markdown]
# An apartment of the release, generated anew from its seed; a place in it where half of all views fail.

# %%
showcase = open_showcase(open_release(), "apartment-210")
location = showcase.instructive_location()

# %% [markdown]
# ## Voxels, directions, occlusion
#
# - **a** A layer of voxels at the height of eyes. Shaded ones are free: clear of walls and furniture, above a floor,
#   inside the building. The star is the location that b and c are about.
# - **b** Its 500 directions on the sphere: +x in the middle, +y halfway to the right, up above. The 100 that see most
#   landmarks are kept, coloured by how many they see: towards the kitchen, and down at the floor in the doorway. The
#   ceiling and the wall to the bedroom are dropped.
# - **c** What decides it: landmarks with a free line of sight (orange) and hidden ones (blue). Through the doorway one
#   sees a wedge of the kitchen; the bathroom is full of landmarks of which none can be seen.

# %%
display(sampling_figure(sampling_of(showcase, location)))

# %% [markdown]
# ## Another place, another answer
#
# In the bathroom it is the other way round: its own landmarks are in sight now, those of the living room are hidden.
# The directions that see most look at the wall with the door, and through it into the kitchen.

# %%
bathroom = showcase.nearest_location([-2.5, 2.0, 1.5])
display(sampling_figure(sampling_of(showcase, bathroom)))

# %% [markdown]
# ## Lattices of directions
#
# Five hundred directions, three ways. The spherical Fibonacci lattice covers the sphere evenly. Equal steps of azimuth
# and elevation crowd at the poles. The paper's printed formula is undefined for half of its indices, and its released
# code uses the two angles on the wrong axes: directions crowd at two poles and leave holes, so that some direction lies
# 20° from the nearest sampled one.

# %%
display(fibonacci_figure(500))
