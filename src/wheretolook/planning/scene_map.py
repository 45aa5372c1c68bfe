"""Build the viewpoint map of a scene or COLMAP model, and its variant for planners."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from wheretolook.dataset.environment import Environment
from wheretolook.dataset.thresholds import Accuracy
from wheretolook.geometry.lattices import ViewLattice
from wheretolook.planning.map_building import build_viewpoint_map
from wheretolook.planning.rrt import Space
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import FALLBACK, is_probability, make_scorer, methods_named, scorers
from wheretolook.weights.resolve import load_scorer

REACH = 2  # voxels along each axis from which views may be taken

INSIDE = np.stack(np.meshgrid(*[(-1 / 3, 0.0, 1 / 3)] * 3, indexing="ij"), -1).reshape(-1, 3)
"""Points (27, 3) of a voxel that are tested for free space, relative to its centre in units of its size."""


def scene_scorer(
    scene: Environment,
    method: str = "",
    weights: Path | None = None,
    anywhere: bool = False,
    accuracy: Accuracy | None = None,
) -> Scorer:
    """Build the scorer of a scene by a method; an empty one stands for that of the weights, or bins.

    With `anywhere`, weights adapted to another scene are allowed. An `accuracy` is that of its scores.

    Raises:
        ConfigError: no such method, or it needs weights, or has no such accuracy. WeightsError: the weights cannot be used.
        MapError: the map lacks what the method needs.
    """
    if weights is not None and not method:
        scorer = load_scorer(weights, scene.localization_map, anywhere=anywhere)
    else:
        scorer = make_scorer(method or FALLBACK, scene.localization_map, weights=weights, anywhere=anywhere)
    return scorer if accuracy is None else scorer.at_accuracy(accuracy)


def scene_viewpoint_map(scene: Environment, views: ViewLattice, scorer: Scorer) -> ViewpointMap:
    """Build the viewpoint map of a scene by a scorer of its views, with progress bars.

    Raises SceneError if no voxel is free, MapError if there are no landmarks.
    """
    grid, free = scene.free_voxels(views, scene.space)
    return build_viewpoint_map(scorer, grid, free, views.axes(), views.lattice, f"viewpoint map {scene.name}")


def planner_map(scene: Environment, views: ViewLattice, scorer: Scorer) -> ViewpointMap:
    """Build the map for planners: scores in [0, 1], and views wherever a camera can be.

    Scores that are no probabilities are replaced by ranks, and partially free voxels are filled. Raises as
    `scene_viewpoint_map`.
    """
    scored = scene_viewpoint_map(scene, views, scorer)
    if not is_probability(scored.origin.scorer):
        scored = shares_below(scored)
    return fill_partially_free_voxels(scored, scene.space)


def check_methods(methods: Iterable[str]) -> None:
    """Raise a ConfigError if there is no method of a name; an empty one stands for that of the weights."""
    for name in filter(None, methods):
        methods_named([name], scorers())


def shares_below(viewpoint_map: ViewpointMap) -> ViewpointMap:
    """Replace each score by the share of all views in the map that score lower: a ranking in [0, 1].

    Planning weighs scores against metres, and information has other units and no upper limit.
    """
    ordered = np.sort(viewpoint_map.scores, axis=None)
    shares = np.searchsorted(ordered, viewpoint_map.scores, side="left") / max(1, ordered.size - 1)
    origin = viewpoint_map.origin.derive("scores replaced by ranks")
    return replace(viewpoint_map, scores=shares.astype(np.float32), origin=origin)


def fill_partially_free_voxels(viewpoint_map: ViewpointMap, space: Space) -> ViewpointMap:
    """Give voxels with free space but an occupied centre the views of the nearest voxel in reach.

    A voxel is in reach if a camera can go straight to its centre, so no views are taken through walls. In the result, a
    derived map (`MapOrigin.derived`), voxels share rows, so it can be neither saved nor updated.
    """
    rows = viewpoint_map.row_of_voxel.copy()
    centers = viewpoint_map.grid.centers()
    size = viewpoint_map.grid.voxel_m
    known = np.flatnonzero(rows >= 0)
    unknown = np.flatnonzero(rows < 0)
    points = centers[unknown][:, None] + INSIDE * size
    free = space.is_free(points.reshape(-1, 3)).reshape(len(unknown), len(INSIDE))
    order = np.argsort((INSIDE**2).sum(1), kind="stable")
    for voxel, inside, is_free in zip(unknown, points, free, strict=True):
        if not is_free.any():
            continue
        start = inside[order[is_free[order]][0]]  # the free point nearest to the centre
        near = known[(np.abs(centers[known] - centers[voxel]) <= (REACH + 1e-6) * size).all(1)]
        near = near[np.argsort(np.linalg.norm(centers[near] - start, axis=1), kind="stable")]
        if len(near):
            clear = space.segments_are_free(np.tile(start, (len(near), 1)), centers[near])
            if clear.any():
                rows[voxel] = viewpoint_map.row_of_voxel[near[int(np.argmax(clear))]]
    return replace(viewpoint_map, row_of_voxel=rows, origin=viewpoint_map.origin.derive("views borrowed by neighbours"))
