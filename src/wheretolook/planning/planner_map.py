"""The viewpoint map that a planner is given: scores in [0, 1], and something to go by wherever a camera can be."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.geometry.lattices import Lattice
from wheretolook.methods.registry import find, members, methods_named, scorers
from wheretolook.planning.borrowing import with_borrowed_views
from wheretolook.planning.config import ViewpointMapConfig
from wheretolook.planning.path_comparison import shares_below
from wheretolook.planning.scene_map import scene_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.errors import ConfigError
from wheretolook.visibility.occlusion import OcclusionModel


def planner_map(
    method: str, weights: Path | None, grid: tuple[int, int, int], directions: int, lattice: Lattice,
    scene: SceneFolder, dataset: Dataset, space: FreeSpace | MappedSpace, occlusion: OcclusionModel,
    device: str = "cpu",
) -> ViewpointMap:  # fmt: skip
    """What a method makes of a scene's views: probabilities, or ranks of scores that are none, borrowed where needed.

    Args:
        method: that scores; empty for that of the weights, or bins without.
        weights: of the method (`wheretolook.planning.scene_map.weights_for`).
        grid: voxels along x, y and z.
        directions: at each voxel.
        lattice: of the directions.
        scene: its files.
        dataset: gives the camera.
        space: where a camera can be.
        occlusion: which landmarks nothing stands in front of.
        device: where kernels run.

    Raises:
        ConfigError: the method needs weights. Else as `wheretolook.planning.scene_map.scene_viewpoint_map`.
    """
    if weights is None and any(known.weights for known in members(method, scorers())):
        raise ConfigError(f"{method} needs weights", path=dataset.root, fix="Train it, or name weights.")
    config = ViewpointMapConfig(method=method, weights=weights, grid=grid, directions=directions, lattice=lattice)
    views = scene_viewpoint_map(scene, dataset.camera, config, space, occlusion, device)
    scored_by = find(views.origin.scorer)
    if scored_by is None or not scored_by.probability:
        views = shares_below(views)
    return with_borrowed_views(views, space)


def check_methods(methods: Iterable[str]) -> None:
    """Check names of methods before anything is built for them.

    Args:
        methods: "forward", or names of scorers; empty for that of the weights.

    Raises:
        ConfigError: there is none of a name.
    """
    for name in methods:
        if name:
            methods_named([name], scorers())
