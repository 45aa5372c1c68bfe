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
# # Where to look: the whole line in one picture
#
# **Where should a camera point so that it knows where it is?** This notebook draws the answer on one apartment that the
# network has never seen: the map, the viewpoints sampled in it, the view that is ranked best at each place, and one
# camera that is turned accordingly. It needs nothing but the release that ships, `data/release`, and runs in about a
# minute.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from IPython.display import Markdown, display

from wheretolook import load_scorer
from wheretolook_paper.figures.peaks import peaks_figure
from wheretolook_paper.figures.pipeline import pipeline_figure
from wheretolook_paper.release.notebook import open_release
from wheretolook_paper.release.showcase import open_showcase
from wheretolook_paper.release.showcase_figures import peaks_of, pipeline_of

# %% [markdown]
# The release holds landmarks, viewpoints and labels, but no meshes: the apartment is generated anew from its seed. That
# it is the same one is checked by its lines of sight, which must be those stored with the labels.

# %%
release = open_release()
showcase = open_showcase(release, "apartment-210")
Markdown(showcase.summary())

# %% [markdown]
# The scorer that ships knows the landmarks and the pose, never the image. It has learnt from 32 other scenes:
# apartments, halls, offices, courts, and buildings whose rooms repeat.

# %%
scorer = load_scorer(release.root / "weights", showcase.localization_map)
location = showcase.instructive_location()

# %% [markdown]
# ## From map to camera
#
# Four times the same rooms, seen from above with the ceiling and the near walls taken away.
#
# - **a** The mapping cameras (blue) walked through three rooms and never entered the fourth, the bedroom: no landmark
#   (orange) is there.
# - **b** Cameras could stand anywhere in free space and look anywhere. One layer of locations is shown, with 32 of the
#   500 directions of each.
# - **c** The best view of each location. In the mapped rooms there is one almost everywhere; in the bedroom there is
#   hope only beside the door, and the network knows it.
# - **d** The camera at a place where half of all views fail, turned to its best view, what it sees from there, and
#   what came of localizing that image.

# %%
display(pipeline_figure(pipeline_of(showcase, scorer, location)))

# %% [markdown]
# ## One place, every direction
#
# The same place in detail: each dot is a direction, light where the network expects the camera to be localized. Rings
# and crosses tell what really came of views that were rendered and localized; the network was not told.

# %%
display(peaks_figure(*peaks_of(showcase, scorer, location)))

# %% [markdown]
# ## Turn it yourself
#
# On a machine with a display, this opens the scene, its landmarks and the mapping cameras in Open3D's viewer:
#
# ```python
# from wheretolook_paper.figures.viewer import show_scene
#
# localization_map = showcase.localization_map
# show_scene(showcase.mesh, localization_map.landmarks.points, localization_map.mapping_poses, cut_m=1.5)
# ```
