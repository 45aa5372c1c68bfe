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
# From a COLMAP model to camera views in ten cells: read the model, load the bundled scorer, build a viewpoint map,
# query, refine and save it. Three small rooms are generated and mapped as an example; replace them by the path of your
# model. It must be in metres, z up.

# %%
# %matplotlib inline
# %config InlineBackend.figure_formats = ["retina"]
from pathlib import Path
from tempfile import mkdtemp

from IPython.display import display
from PIL import Image

from wheretolook import LocalizationMap, load_scorer, poses_looking_along
from wheretolook.dataset.sampling import free_locations
from wheretolook.figures.dollhouse import dollhouse
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.planning.map_building import build_viewpoint_map
from wheretolook.planning.refine import refine_directions
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook_paper.figures.pipeline import ranked_figure
from wheretolook_paper.release.example_model import make_example_model
from wheretolook_paper.release.notebook import open_release

# %% [markdown]
# ## A map
#
# Use your own folder here. This example is generated: a small apartment, rendered and mapped.

# %%
folder = Path(mkdtemp())
example = make_example_model(folder)
print(*sorted(path.name for path in example.model.iterdir()), sep="\n")

# %% [markdown]
# ## Read the model
#
# A COLMAP folder, binary or text. With a mesh of the rooms occlusion is exact; without,
# `occlusion=HiddenPointRemoval()` estimates it from the landmarks.

# %%
localization_map = LocalizationMap.from_colmap(example.model, mesh=example.scan)
print(f"{len(localization_map.landmarks):,} landmarks, {len(localization_map.mapping_poses)} mapping cameras")

# %% [markdown]
# ## Score any pose
#
# With the bundled weights. A score is the probability that the camera localizes within 5 cm and 0.4°.

# %%
scorer = load_scorer(open_release().root / "weights", localization_map)
scorer.score(poses_looking_along([[1.0, 0.5, 1.5]] * 2, [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))

# %% [markdown]
# ## Build the viewpoint map
#
# Free voxels of about half a metre with 200 directions each, every one scored once.

# %%
mesh = load_mesh(example.scan)
space = FreeSpace(mesh)
grid = VoxelGrid.over(space.bounds, (10, 8, 4))
views = build_viewpoint_map(scorer, grid, free_locations(grid, space), fibonacci_sphere(200), "fibonacci")

# %% [markdown]
# The best view of every free voxel of a layer, seen from above. Light views are likely to localize. Where all are dark,
# no direction helps: the mapping camera has not been there.

# %%
layer = views.locations[abs(views.locations[:, 2] - 1.5) < 0.33]
best = views.best_many(layer)
display(ranked_figure(dollhouse(mesh, cut_m=1.5), layer, views.directions[best.direction_id], best.score))

# %% [markdown]
# ## Query
#
# The best view at a point, in microseconds; `best_n`, `best_in_cone` and `best_reachable` return more. The location
# shown is the one with the lowest best score.

# %%
place = layer[abs(best.score - 0.5).argmin()]
choice = views.best(place)
print(choice)

# %% [markdown]
# ## Refine
#
# A local search over the sphere improves directions between those of the lattice, with the same scorer.

# %%
refined = refine_directions(scorer, [place], [choice.axis])
print(f"{refined.start_scores[0]:.4f} on the lattice, {refined.scores[0]:.4f} after {refined.n_scored} more views")

# %% [markdown]
# The image of that view:

# %%
pose = poses_looking_along([place], refined.axes)
Image.fromarray(WarpRenderer(mesh).render(localization_map.camera, pose).rgb[0])

# %% [markdown]
# ## Save
#
# A folder of plain `.npy` files with a documented layout, for planners in any language.

# %%
views.save(folder / "viewpoint-map")
print(ViewpointMap.load(folder / "viewpoint-map").best(place))
