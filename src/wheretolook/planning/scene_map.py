"""The viewpoint map of a scene of a dataset, the weights that score it, and the map that a planner is given."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from wheretolook.dataset.environment import SceneEnvironment
from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.lattices import ViewLattice
from wheretolook.planning.map_building import build_viewpoint_map
from wheretolook.planning.rrt import Space
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import fallback, find, make_scorer, members, methods_named, scorers
from wheretolook.utils.errors import ConfigError
from wheretolook.weights.resolve import load_scorer

REACH = 2  # a voxel borrows from voxels at most this many away along each axis

INSIDE = np.stack(np.meshgrid(*[(-1 / 3, 0.0, 1 / 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
"""Points of a voxel that are tested for free space (27, 3), relative to its centre in units of its size."""


def scene_scorer(
    scene: SceneEnvironment, method: str = "", weights: Path | None = None, anywhere: bool = False
) -> Scorer:
    """What scores views of a scene by a method (empty for that of the weights, or bins).

    With `anywhere`, weights that are adapted to one place score in another, too.

    Raises:
        ConfigError: no such method, or it needs weights. WeightsError: the weights cannot be used.
        MapError: the map lacks what the method needs.
    """
    if weights is not None and not method:
        return load_scorer(weights, scene.localization_map, anywhere=anywhere)
    return make_scorer(method or fallback().name, scene.localization_map, weights=weights, anywhere=anywhere)


def scene_viewpoint_map(scene: SceneEnvironment, views: ViewLattice, scorer: Scorer) -> ViewpointMap:
    """Build the viewpoint map of a scene by a scorer of its views, with progress bars.

    Raises SceneError if no voxel is free, MapError if there are no landmarks.
    """
    grid, free = scene.free_voxels(views, scene.space)
    return build_viewpoint_map(scorer, grid, free, views.axes(), views.lattice, f"viewpoint map {scene.name}")


def planner_scorer(
    scene: SceneEnvironment, dataset: Dataset, method: str = "", weights: Path | None = None, anywhere: bool = False
) -> Scorer:
    """The scorer by which paths are planned in a scene of a dataset, with weights from `resolve_weights`.

    `anywhere` as of `scene_scorer`. Raises as that; where weights are missing, the error names the dataset.
    """
    if weights is None and any(known.weights for known in members(method, scorers())):
        raise ConfigError(f"{method} needs weights", path=dataset.root, fix="Train it, or name weights.")
    return scene_scorer(scene, method, weights, anywhere)


def planner_map(scene: SceneEnvironment, views: ViewLattice, scorer: Scorer) -> ViewpointMap:
    """The map that a planner is given: scores in [0, 1], and something to go by wherever a camera can be.

    Scores are the scorer's probabilities, or ranks of scores that are none; views are borrowed where needed. Raises as
    `scene_viewpoint_map`.
    """
    scored = scene_viewpoint_map(scene, views, scorer)
    scored_by = find(scored.origin.scorer)
    if scored_by is None or not scored_by.probability:
        scored = shares_below(scored)
    return with_borrowed_views(scored, scene.space)


def check_methods(methods: Iterable[str]) -> None:
    """Raise a ConfigError if there is no method of a name; an empty one stands for that of the weights."""
    for name in filter(None, methods):
        methods_named([name], scorers())


def shares_below(viewpoint_map: ViewpointMap) -> ViewpointMap:
    """The map with the share of all its views that score lower in place of each score: a ranking, in [0, 1].

    Planning weighs scores against metres. Information has no upper end and other units, so it enters by its ranks.
    """
    ordered = np.sort(viewpoint_map.scores, axis=None)
    shares = np.searchsorted(ordered, viewpoint_map.scores, side="left") / max(1, ordered.size - 1)
    origin = viewpoint_map.origin.derive("scores replaced by ranks")
    return replace(viewpoint_map, scores=shares.astype(np.float32), origin=origin)


def with_borrowed_views(viewpoint_map: ViewpointMap, space: Space) -> ViewpointMap:
    """A map for planners: voxels with free space but an occupied centre get the views of the nearest voxel in reach.

    A voxel is in reach if a camera can go straight to its centre, so nothing is borrowed through walls. In the result,
    a derived map (`MapOrigin.derived`), voxels share rows, so it can be neither saved nor updated.
    """
    rows = viewpoint_map.row_of_voxel.copy()
    centers = viewpoint_map.grid.centers()
    size = viewpoint_map.grid.voxel_m
    known = np.flatnonzero(rows >= 0)
    unknown = np.flatnonzero(rows < 0)
    points = centers[unknown][:, None] + INSIDE * size
    free = space.is_free(points.reshape(-1, 3)).reshape(len(unknown), len(INSIDE))
    order = np.argsort((INSIDE**2).sum(1), kind="stable")
    for voxel, own, is_free in zip(unknown, points, free, strict=True):
        if not is_free.any():
            continue
        start = own[order[is_free[order]][0]]  # the free point nearest to the centre
        near = known[(np.abs(centers[known] - centers[voxel]) <= (REACH + 1e-6) * size).all(1)]
        near = near[np.argsort(np.linalg.norm(centers[near] - start, axis=1), kind="stable")]
        if len(near):
            clear = space.segments_are_free(np.tile(start, (len(near), 1)), centers[near])
            if clear.any():
                rows[voxel] = viewpoint_map.row_of_voxel[near[int(np.argmax(clear))]]
    return replace(viewpoint_map, row_of_voxel=rows, origin=viewpoint_map.origin.derive("views borrowed by neighbours"))
