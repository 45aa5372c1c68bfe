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
# # Your own map
#
# Open a COLMAP model with `WhereToLook` and ask where to look. Three small rooms are generated and mapped as an
# example; replace `example.model` by the folder of your own model, and leave out `mesh` without one.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from tempfile import mkdtemp

import pandas as pd

from wheretolook import WhereToLook
from wheretolook_paper.release.example_model import make_example_model

example = make_example_model(mkdtemp())
look = WhereToLook.from_colmap(example.model, mesh=example.scan)
views = look.best([(-2.5, -1.5, 1.6), (1.0, 0.5, 1.6), (2.5, 1.5, 1.6)])

views.save(f"{example.model}/views.csv")
table = pd.read_csv(f"{example.model}/views.csv")
table[["x", "y", "z", "yaw_deg", "pitch_deg", "score", "expected_inliers", "n_visible", "in_range"]].round(2)

# %% [markdown]
# A score is the probability that the camera localizes within 5 cm and 0.4°. `views` has an array for each column of the
# file, which may also be a TUM trajectory, COLMAP's `images.txt` or JSON.

# %% [markdown]
# ## The whole floor
#
# Waypoints every 0.4 m in free space, and the best view at each of those at the height of a camera. Light views are
# likely to localize. Where all are dark no direction helps: the mapping camera has not been there.

# %%
from wheretolook.scenes.loading import load_mesh
from wheretolook_paper.figures.dollhouse import dollhouse
from wheretolook_paper.figures.pipeline import ranked_figure

waypoints = look.grid(0.4)
floor = look.best(waypoints[abs(waypoints.points[:, 2] - 1.5) < 0.2])
mesh = load_mesh(example.scan)
ranked_figure(dollhouse(mesh, cut_m=1.5), floor.positions, floor.axes, floor.score)

# %% [markdown]
# ## One view
#
# The image of the selected view at the second waypoint.

# %%
from PIL import Image

from wheretolook.rendering.warp_renderer import WarpRenderer

Image.fromarray(WarpRenderer(mesh).render(views.camera, views.cam_from_world[1:2]).rgb[0])

# %% [markdown]
# `score` takes any poses (B, 3, 4), world to camera: here that view, and the one after the camera has turned by 180°.

# %%
import numpy as np

turned = np.diag([-1.0, 1.0, -1.0]) @ views.cam_from_world[1]
look.score(np.stack([views.cam_from_world[1], turned]))

# %% [markdown]
# ## Several views from one place
#
# Where the best single view is uncertain, several can be localized together. `set_score` is the probability that they
# are. The location here is the one whose best view scores closest to 0.5.

# %%
row = abs(floor.score - 0.5).argmin()
together = look.best(floor.positions[[row]], looks=3)
print(f"one view {floor.score[row]:.2f}, three views {together.set_score[0]:.2f}")

# %% [markdown]
# ## On photographs
#
# The same calls work on a map of photographs. An example to repeat: 50 photographs of a mounted fox, taken with a
# hand-held phone, from the [data of instant-ngp](https://github.com/NVlabs/instant-ngp/tree/master/data/nerf/fox)
# (not included, since their licence excludes commercial use).
#
# ```sh
# wheretolook map --name fox --images fox/images
# wheretolook check --map data/fox/images/map
# wheretolook view --map data/fox/images/map
# ```
#
# All 50 are placed, with 6,142 landmarks, in 74 s on two cores. `check` holds out blocks of neighbouring photographs and
# localizes them against the rest of the map. Its results for these, within 1 % of the median depth and 0.4° since their
# scale is unknown, and for 200 photographs of the kitchen of 7-Scenes, within 5 cm and 0.4°:

# %%
from wheretolook_paper.release.notebook import open_release

photographs = pd.read_csv(open_release().root / "results" / "photographs.csv").set_index(["scene", "method"])


def with_interval(row, name):
    return f"{row[name]:.2f} [{row[f'{name}_low']:.2f}, {row[f'{name}_high']:.2f}]"


checks = {}
for scene, rows in photographs.groupby(level="scene"):
    ours, counted = rows.loc[(scene, "set")], rows.loc[(scene, "visible")]
    checks[scene] = {
        "held-out views that localize": f"{ours['good']:.0f} of {ours['views']:.0f}",
        "of two views, the one that localizes scores higher": with_interval(ours, "auc"),
        "likewise by the number of visible landmarks": with_interval(counted, "auc"),
        "calibration error": with_interval(ours, "ece"),
        "observed inliers / expected": f"{ours['real_over_expected_localized']:.2f}",
    }
pd.DataFrame(checks)

# %% [markdown]
# Places differ, so check your own before using the probabilities: docs/photographs.md, docs/check.md. Planned paths are
# in the notebook 07_planning.
