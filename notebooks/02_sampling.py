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
# # Sampling viewpoints
#
# Locations are the centres of free voxels, directions a lattice on the sphere, of which those with the most visible
# landmarks are kept. Sections 3.1 and 3.2 of the paper, shown on a test apartment of the release.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import display

from wheretolook_paper.figures.sampling import fibonacci_figure, sampling_figure
from wheretolook_paper.release.notebook import open_release
from wheretolook_paper.release.showcase import open_showcase, sampling_of

# %% [markdown]
# An apartment of the release, generated again from its seed, and a location where half of all views fail.

# %%
showcase = open_showcase(open_release(), "apartment-210")
location = showcase.instructive_location()

# %% [markdown]
# ## Voxels, directions, occlusion
#
# - **a** A layer of voxels at eye height. Shaded voxels are free: clear of walls and furniture, above a floor, inside
#   the building. The star is the location of b and c.
# - **b** Its 500 directions on the sphere: +x in the middle, +y halfway to the right, up above. The 100 with the most
#   visible landmarks are kept, coloured by their number: towards the kitchen, and down at the floor in the doorway.
#   Ceiling and bedroom wall are dropped.
# - **c** Unoccluded (orange) and occluded (blue) landmarks. A wedge of the kitchen is visible through the doorway; none
#   of the bathroom's many landmarks is.

# %%
display(sampling_figure(sampling_of(showcase, location)))

# %% [markdown]
# ## Another location
#
# In the bathroom its own landmarks are unoccluded and those of the living room are not. The directions with the most
# visible landmarks face the wall with the door and, through it, the kitchen.

# %%
bathroom = showcase.nearest_location([-2.5, 2.0, 1.5])
display(sampling_figure(sampling_of(showcase, bathroom)))

# %% [markdown]
# ## Direction lattices
#
# Three lattices of five hundred directions. The spherical Fibonacci lattice covers the sphere evenly. Equal steps of
# azimuth and elevation crowd at the poles. The paper's printed formula is undefined for half of its indices, and its
# released code puts the two angles on the wrong axes: directions crowd at two poles and leave gaps of up to 20°.

# %%
display(fibonacci_figure(500))
