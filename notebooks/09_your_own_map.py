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
# # Your own map
#
# **How do I get from a COLMAP model to a camera that knows where to look?** In ten cells: read the model, load the
# scorer that ships, build a viewpoint map, ask it, refine its answer, keep it. To have a model to try it on, three
# small rooms are generated and mapped first; put the path of your own model in their place. It must be in metres, z up.

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
# Put your own folder here. This one is made on the spot: a small apartment, photographed and mapped.

# %%
folder = Path(mkdtemp())
example = make_example_model(folder)
print(*sorted(path.name for path in example.model.iterdir()), sep="\n")

# %% [markdown]
# ## Read the model
#
# A COLMAP folder, binary or text. With a mesh of the same rooms, landmarks behind walls are known to be hidden; without
# one, `occlusion=HiddenPointRemoval()` guesses it from the landmarks alone.

# %%
localization_map = LocalizationMap.from_colmap(example.model, mesh=example.scan)
print(f"{len(localization_map.landmarks):,} landmarks, {len(localization_map.mapping_poses)} mapping cameras")

# %% [markdown]
# ## Score any pose
#
# The best of the weights that ship. A score is the probability that a camera there localizes within 5 cm and 0.4°.

# %%
scorer = load_scorer(open_release().root / "weights", localization_map)
scorer.score(poses_looking_along([[1.0, 0.5, 1.5]] * 2, [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))

# %% [markdown]
# ## Build the viewpoint map
#
# Voxels of about half a metre, those that a camera can be in, 200 directions at each: every one is scored once and for
# all.

# %%
mesh = load_mesh(example.scan)
space = FreeSpace(mesh)
grid = VoxelGrid.over(space.bounds, (10, 8, 4))
views = build_viewpoint_map(scorer, grid, free_locations(grid, space), fibonacci_sphere(200), "fibonacci")

# %% [markdown]
# The best view of every free voxel of a layer, seen from above. Light ones will localize. Where all are dark, no turn
# of the camera helps: the walk of the mapping camera has never been there.

# %%
layer = views.locations[abs(views.locations[:, 2] - 1.5) < 0.33]
best = views.best_many(layer)
display(ranked_figure(dollhouse(mesh, cut_m=1.5), layer, views.directions[best.direction_id], best.score))

# %% [markdown]
# ## Ask it
#
# What a planner asks: the best view at a point, in microseconds; `best_n`, `best_in_cone` and `best_reachable` ask for
# more. The place here is the one where the scorer is least sure of its best view.

# %%
place = layer[abs(best.score - 0.5).argmin()]
choice = views.best(place)
print(choice)

# %% [markdown]
# ## Refine
#
# Between the directions of the lattice there may be a better one: a local search over the sphere, with the same scorer.

# %%
refined = refine_directions(scorer, [place], [choice.axis])
print(f"{refined.start_scores[0]:.4f} on the lattice, {refined.scores[0]:.4f} after {refined.n_scored} more views")

# %% [markdown]
# And this is what the camera sees then:

# %%
pose = poses_looking_along([place], refined.axes)
Image.fromarray(WarpRenderer(mesh).render(localization_map.camera, pose).rgb[0])

# %% [markdown]
# ## Keep it
#
# A folder of plain `.npy` files with a written layout, for planners in any language.

# %%
views.save(folder / "viewpoint-map")
print(ViewpointMap.load(folder / "viewpoint-map").best(place))
