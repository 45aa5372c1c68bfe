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
# # Planning: the same path with other views
#
# Does selecting views along a path improve localization? Three plans between two places of an apartment, looking ahead,
# by Fisher information and by the set network (the paper's planning figure); then the results of twenty such pairs in
# each of eight scenes, with every view rendered and localized.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
import pandas as pd
from IPython.display import Markdown, display

from wheretolook.planning.config import PathConfig, PlanConfig
from wheretolook.planning.scene_map import path_views, plan_by_methods
from wheretolook.tracking import newest_artifact
from wheretolook_paper.figures.paths import (
    methods_figure,
    paths_figure,
    photograph_paths_figure,
    photograph_paths_markdown,
    read_photograph_paths,
    still_figure,
)
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.path_report import path_markdown
from wheretolook_paper.release.notebook import open_release, open_store
from wheretolook_paper.release.showcase import open_showcase

# %% [markdown]
# ## Three methods
#
# Start and goal in an apartment not used for training. The cost of a path is its length, its rotation and, per metre,
# the score its views lack.

# %%
release = open_release()
showcase = open_showcase(release, "apartment-210")
start = [-1.83, 1.20, 1.55]
goal = [2.24, -2.12, 1.53]
config = PlanConfig(grid=(8, 8, 4), directions=200, planner=PathConfig(time_s=6.0))

# %% [markdown]
# Each method has its own viewpoint map of 8 × 8 × 4 voxels with 200 directions; the network's takes half a minute on
# two cores. RRT* searches a short path, and places and views jointly, and improves the cheapest within the time budget.

# %%
localization_map = showcase.localization_map
methods = ["forward", "fisher-trace-gp", "set"]
paths = plan_by_methods(showcase, release, methods, start, goal, config)

# %% [markdown]
# From above, with arrows for the viewing directions. All three take nearly the same path. Looking ahead, the camera
# ends facing a hardly mapped corner; the other two keep facing landmarks.

# %%
renderers = {"set": showcase.renderer}
views = {name: path_views(path, localization_map, renderers.get(name)) for name, path in paths.items()}
display(methods_figure(views, localization_map.landmarks.points))

# %% [markdown]
# ## Images along the path
#
# Five views along the last path with their landmarks, and the score along it. As a film: `wheretolook plan --film gif`.

# %%
display(still_figure(views["set"], localization_map.landmarks.points, "apartment 210, set of landmarks"))

# %% [markdown]
# ## Photographs
#
# As in the paper, paths on maps of photographs, which no method is trained on: a kitchen (200 photographs of 7-Scenes,
# metric) and a church door (12 photographs of unknown scale; lengths are in median depths of its landmarks). Paths lead
# from one of the two photographs that are farthest apart to the other, near the cameras of the map. Below each: the
# landmarks visible along it, occluded ones excluded, and the photographs nearest to three views, framed by whether
# they localize when they and their neighbours are held out of the map.
#
# The photographs are not part of the release, only their names. `python -m wheretolook_paper.studies.plan_photographs
# --help` names the command that shows them, given their folder.

# %%
table, landmarks = read_photograph_paths(release)
display(photograph_paths_figure(table, landmarks))
display(Markdown(photograph_paths_markdown(table)))

# %% [markdown]
# ## Results
#
# Views that localize within 0.25 m and 2°, with 95 % intervals over pairs of start and goal. Left, places and views
# planned; right, views along given paths with at most 30° between waypoints, exact (filled) and by the greedy rule of
# the Active Localization Benchmark (open); looking ahead has no limit.

# %%
summary = pd.read_csv(newest_artifact(open_store(release), "paths", "paths.csv", release.name))
display(paths_figure(summary))
display(Markdown(path_markdown(summary, PathsConfig())))
