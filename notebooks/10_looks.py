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
# # Several looks
#
# **Does it help a lost robot to look twice?** What one camera view finds may be wrong, with a hundred inliers, where a
# map resembles itself. But a robot knows how far it turned between two looks, so their matches must agree on one pose.
# This notebook maps a generated apartment, asks at twenty places for two looks, localizes each alone and both together,
# and shows a place where it made the difference; then it shows what was measured on sixteen scenes.

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
from wheretolook.figures.dollhouse import dollhouse
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
from wheretolook_paper.figures.look_film import still_figure, tell_looks
from wheretolook_paper.figures.looks import looks_figure
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
# ## Two looks at twenty places
#
# The places are drawn of all free ones about as high as a robot's camera.

# %%
grid = VoxelGrid.over(space.bounds, (14, 14, 8))
free = grid.centers()[free_locations(grid, space)]
places = np.random.default_rng(3).choice(free[abs(free[:, 2] - 1.3) < 0.5], 20, replace=False)

# %% [markdown]
# At each, 100 directions are scored; two of them are chosen that are expected to localize best together. The one that
# is best alone comes first.

# %%
scorer = load_scorer(open_release().root / "weights", localization_map)
directions = fibonacci_sphere(100)


def two_looks(place):
    scores = scorer.score(poses_looking_along(np.tile(place, (len(directions), 1)), directions))
    looks = sorted(best_views(scorer, place, directions, scores, 2).rows, key=lambda look: -scores[look])
    return poses_looking_along(np.tile(place, (2, 1)), directions[looks])


# %% [markdown]
# Each look is rendered and localized, alone and together with the other. How many places are right within 5 cm and
# 0.4°?

# %%
pairs = [two_looks(place) for place in places]
stories = [tell_looks(localizer, camera, poses, renderer.render(camera, poses).rgb) for poses in pairs]
right = {f"look {number + 1} alone": sum(story.alone[number].right for story in stories) for number in (0, 1)}
right["both together"] = sum(story.together.right for story in stories)
display(pd.Series(right, name=f"of {len(stories)} places").to_frame())

# %% [markdown]
# How sure the pose of both looks is, where it is right and where it is wrong.

# %%
sure = pd.DataFrame([(story.together.right, story.together.chance) for story in stories], columns=["right", "sure"])
display(sure.groupby("right").describe().round(2))

# %% [markdown]
# ## Where it makes the difference
#
# The place where the first look is most wrong and both together are right. Blue is where the camera is, dashed where it
# believes to be; points in the images are the matches that agree with that.

# %%
helped = [story for story in stories if story.together.right] or stories
shown = max(helped, key=lambda story: story.alone[0].error_m if np.isfinite(story.alone[0].error_m) else 0.0)
display(still_figure(shown, dollhouse(mesh, elevation_deg=62, cut_m=1.6)))

# %% [markdown]
# ## What was measured
#
# Eight generated scenes on which choices were made, and eight on which none was, six of them by others. A second look
# brings most; which of the good ones is taken hardly matters, that their poses are joined does. How: docs/looks.md.

# %%
display(looks_figure(pd.read_csv(open_release().root / "results" / "looks.csv")))
