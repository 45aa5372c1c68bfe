"""The viewpoint map that a planner is given: scores in [0, 1], and something to go by wherever a camera can be."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from wheretolook.dataset.folders import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.geometry.lattices import ViewLattice
from wheretolook.methods.registry import find, members, methods_named, scorers
from wheretolook.planning.borrowing import with_borrowed_views
from wheretolook.planning.path_comparison import shares_below
from wheretolook.planning.scene_map import scene_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.utils.errors import ConfigError


def planner_map(
    scene: Scene, dataset: Dataset, views: ViewLattice, method: str = "", weights: Path | None = None
) -> ViewpointMap:
    """What a method makes of a scene's views: probabilities, or ranks of scores that are none, borrowed where needed.

    Args:
        scene: of the dataset.
        dataset: named where weights are missing.
        views: voxels and directions.
        method: that scores; empty for that of the weights, or bins without.
        weights: of the method (`wheretolook.planning.scene_map.weights_for`).

    Raises:
        ConfigError: the method needs weights. Else as `wheretolook.planning.scene_map.scene_viewpoint_map`.
    """
    if weights is None and any(known.weights for known in members(method, scorers())):
        raise ConfigError(f"{method} needs weights", path=dataset.root, fix="Train it, or name weights.")
    scored = scene_viewpoint_map(scene, views, method, weights)
    scored_by = find(scored.origin.scorer)
    if scored_by is None or not scored_by.probability:
        scored = shares_below(scored)
    return with_borrowed_views(scored, scene.space)


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
