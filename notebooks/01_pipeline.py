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
# # The pipeline in one figure
#
# **Where should a camera point so that it knows where it is?** One apartment that is not part of the training set: its
# map, the sampled viewpoints, the best view at each location, and one selected camera. Needs only the bundled release,
# `data/release`; about a minute.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import Markdown, display

from wheretolook import load_scorer
from wheretolook_paper.figures.network import peaks_figure
from wheretolook_paper.figures.pipeline import pipeline_figure
from wheretolook_paper.release.notebook import open_release
from wheretolook_paper.release.showcase import open_showcase, peaks_of, pipeline_of

# %% [markdown]
# The release contains landmarks, viewpoints and labels, but no meshes: the apartment is generated again from its seed,
# and its lines of sight are checked against those stored with the labels.

# %%
release = open_release()
showcase = open_showcase(release, "apartment-210")
Markdown(showcase.summary())

# %% [markdown]
# The bundled scorer sees landmarks and pose, never the image. It is trained on 32 other scenes: apartments, halls,
# offices, courts, and buildings with repeated rooms.

# %%
scorer = load_scorer(showcase.localization_map, release.root / "weights")
location = showcase.instructive_location()

# %% [markdown]
# ## From map to camera
#
# The same rooms four times, seen from above without ceiling and near walls.
#
# - **a** The mapping cameras (blue) visited three rooms and not the fourth, the bedroom, which has no landmarks
#   (orange).
# - **b** Viewpoints: one layer of locations in free space, with 32 of the 500 directions of each.
# - **c** The best view at each location. In the mapped rooms nearly every location has one; in the bedroom only near
#   the door, and the predicted probability is low elsewhere.
# - **d** The camera at a location where half of all views fail, turned to its best view; its image; and the result of
#   localizing it.

# %%
display(pipeline_figure(pipeline_of(showcase, scorer, location)))

# %% [markdown]
# ## All directions at one location
#
# Each dot is a direction, light where the predicted probability is high. Rings and crosses mark rendered views that
# localized or failed; the network has not seen them.

# %%
display(peaks_figure(*peaks_of(showcase, scorer, location)))

# %% [markdown]
# ## Interactive
#
# On a machine with a display, this opens the scene, its landmarks and the mapping cameras in Open3D's viewer:
#
# ```python
# from wheretolook_paper.figures.viewer import show_scene
#
# localization_map = showcase.localization_map
# show_scene(showcase.mesh, localization_map.landmarks.points, localization_map.mapping_poses, cut_m=1.5)
# ```
