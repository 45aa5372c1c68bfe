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
# # Planning: the same way, looked at differently
#
# **Does a robot that looks where its map is good know better where it is?** This notebook plans a path between two
# places of an apartment three times, looking ahead, by Fisher information and by the set network (the paper's planning
# figure); then it tells what came of twenty such pairs in each of eight scenes, where every view was rendered and
# localized.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
import pandas as pd
from IPython.display import Markdown, display

from wheretolook.figures.path_film import methods_figure, still_figure
from wheretolook.planning.config import PathConfig, PathsConfig, PlanConfig
from wheretolook.planning.method_paths import path_views, plan_by_methods
from wheretolook.tracking.runs import newest_artifact
from wheretolook_paper.figures.paths import paths_figure
from wheretolook_paper.paths.path_report import path_markdown
from wheretolook_paper.release.notebook import open_release, open_store
from wheretolook_paper.release.showcase import open_showcase

# %% [markdown]
# ## Three ways to look
#
# A start and a goal in an apartment that the network has never seen. A path costs its length, its turns and, for every
# metre, what its views lack in score.

# %%
release = open_release()
showcase = open_showcase(release, "apartment-210")
start = [-1.83, 1.20, 1.55]
goal = [2.24, -2.12, 1.53]
config = PlanConfig(grid=(8, 8, 4), directions=200, planner=PathConfig(time_s=6.0))

# %% [markdown]
# Each method has its own map of scores, eight by eight by four voxels with 200 directions each; the network's takes
# half a minute on two cores. RRT* looks for a short path, and for places and views together; what costs least is
# improved until time is up.

# %%
localization_map = showcase.localization_map
methods = ["forward", "fisher-trace-gp", "set"]
paths = plan_by_methods(showcase, release, methods, start, goal, config)

# %% [markdown]
# From above, with an arrow for where the camera looks. All three go nearly the same way. Looking ahead, the camera ends
# facing a corner that was hardly mapped; the other two keep turning to where the landmarks are.

# %%
renderers = {"set": showcase.renderer}
views = {name: path_views(path, localization_map, renderers.get(name)) for name, path in paths.items()}
display(methods_figure(views, localization_map.landmarks.points))

# %% [markdown]
# ## What the camera sees on its way
#
# Five views along the last path, with the landmarks in them, and the score all along it. The same as a film:
# `wheretolook plan --film gif`.

# %%
display(still_figure(views["set"], localization_map.landmarks.points, "apartment 210, set of landmarks"))

# %% [markdown]
# ## Does it help?
#
# Views that localize within 0.25 m and 2°, with 95 % intervals over pairs of starts and goals. Left, each method chose
# places and views; right, it chose the views along a path that was given, under the limit of 30° between waypoints,
# exactly (filled) and by the greedy rule of the Active Localization Benchmark (open); looking ahead keeps to no limit.

# %%
summary = pd.read_csv(newest_artifact(open_store(release), "paths", "paths.csv", release.name))
display(paths_figure(summary))
display(Markdown(path_markdown(summary, PathsConfig())))
