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
# # Several views from one location
#
# In a map with repeated structure one view may localize at a wrong pose with a hundred inliers. A robot knows the
# rotation between two views, so their matches must agree on one pose. This notebook maps a generated apartment, selects
# two views at twenty locations, localizes each alone and both jointly, and shows a location where it matters; then the
# results on sixteen scenes.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pandas as pd
from IPython.display import display

from wheretolook import LocalizationMap, load_scorer, poses_looking_along
from wheretolook.dataset.sampling import free_locations
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.localization.localizer import Localizer
from wheretolook.looks.selection import best_views
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.rendered_map import build_map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.space.free_space import FreeSpace
from wheretolook_paper.figures.dollhouse import dollhouse
from wheretolook_paper.figures.looks import localize_views, looks_figure, story_figure
from wheretolook_paper.release.notebook import open_release
from wheretolook_rooms.generator import generate_apartment

# %% [markdown]
# ## An apartment and its map
#
# Generated, with the same wallpaper in two rooms.

# %%
folder = Path(mkdtemp())
camera = PinholeCamera()
seed = 536
save_glb(generate_apartment(ApartmentConfig(vary=True), seed), folder / "scan.glb")
mesh = load_mesh(folder / "scan.glb")
space = FreeSpace(mesh)
renderer = WarpRenderer(mesh)
config = MapConfig(n_images=100)

# %% [markdown]
# Mapped from 100 images along a walk, in less than a minute on two cores.

# %%
build_map(mesh, renderer, space, camera, config, seed, folder / "map", space.raycaster, workers=1, progress=False)
localization_map = LocalizationMap.from_colmap(folder / "map", mesh=folder / "scan.glb")
localizer = Localizer(Landmarks.load(folder / "map" / "landmarks.npz"), camera)

# %% [markdown]
# ## Two views at twenty locations
#
# Locations are drawn from free space at the height of a robot's camera.

# %%
grid = VoxelGrid.over(space.bounds, (14, 14, 8))
free = grid.centers()[free_locations(grid, space)]
places = np.random.default_rng(3).choice(free[abs(free[:, 2] - 1.3) < 0.5], 20, replace=False)

# %% [markdown]
# At each, 100 directions are scored, and the two views with the highest joint probability are selected. The best single
# view comes first.

# %%
scorer = load_scorer(localization_map, open_release().root / "weights")
directions = fibonacci_sphere(100)


def two_looks(place):
    scores = scorer.score(poses_looking_along(np.tile(place, (len(directions), 1)), directions))
    looks = sorted(best_views(scorer, place, directions, scores, 2).rows, key=lambda look: -scores[look])
    return poses_looking_along(np.tile(place, (2, 1)), directions[looks])


# %% [markdown]
# Each view is rendered and localized, alone and jointly. At how many locations is the pose correct within 5 cm and
# 0.4°?

# %%
pairs = [two_looks(place) for place in places]
stories = [localize_views(localizer, camera, poses, renderer.render(camera, poses).rgb) for poses in pairs]
right = {f"look {number + 1} alone": sum(story.single[number].is_good for story in stories) for number in (0, 1)}
right["both together"] = sum(story.joint.is_good for story in stories)
display(pd.Series(right, name=f"of {len(stories)} places").to_frame())

# %% [markdown]
# Confidence of the joint pose, where it is correct and where it is not.

# %%
sure = pd.DataFrame([(story.joint.is_good, story.joint.probability) for story in stories], columns=["right", "sure"])
display(sure.groupby("right").describe().round(2))

# %% [markdown]
# ## Where it matters
#
# The location where the first view is most wrong and the joint pose is correct. Solid: true pose; dashed: estimated
# pose; points in the images: the matches that agree with it.

# %%
helped = [story for story in stories if story.joint.is_good] or stories
shown = max(helped, key=lambda story: story.single[0].error_m if np.isfinite(story.single[0].error_m) else 0.0)
display(story_figure(shown, dollhouse(mesh, elevation_deg=62, cut_m=1.6)))

# %% [markdown]
# ## Results
#
# Eight generated validation scenes and eight test scenes, six of them by other authors. A second view helps most; joint
# localization matters more than which views are selected. Details: docs/looks.md.

# %%
display(looks_figure(pd.read_csv(open_release().root / "results" / "looks.csv")))
