"""Compute the data of figures of one scene, given its `Showcase`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses
from wheretolook.geometry.poses import Float, poses_looking_along, rotation_looking_along
from wheretolook.geometry.views import Views
from wheretolook.inputs.channels import CHANNELS
from wheretolook.planning.config import PlanConfig
from wheretolook.planning.scene_map import path_views, plan_by_methods
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.mlp.network import BinnedNetworkScorer
from wheretolook.visibility.counting import Survey, SurveyOptions, survey
from wheretolook.visibility.frustum import pixels_of
from wheretolook_paper.figures.inputs import BinnedImage
from wheretolook_paper.figures.overview import View, outcome_in_words, rendered_views
from wheretolook_paper.figures.peaks import spread_extrema
from wheretolook_paper.figures.pipeline import Pipeline
from wheretolook_paper.figures.sampling import Sampling
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.path_comparison import draw_pairs
from wheretolook_paper.release.showcase import Showcase


class Peaks(NamedTuple):
    """Arguments of `peaks_figure`."""

    directions: Float
    scores: Float
    peaks: tuple[View, ...]
    pits: tuple[View, ...]
    tried: tuple[Float, NDArray[np.bool_]]


class Learning(NamedTuple):
    """Arguments of `learning_figure`."""

    image: BinnedImage
    activations: tuple[Float, ...]
    channels: tuple[str, ...]
    outcome: str


def pipeline_of(showcase: Showcase, scorer: Scorer, location_id: int) -> Pipeline:
    """Return the steps from the scene's map to the best labelled view of a location.

    At each location at eye height, only the K directions with the most visible landmarks are
    scored (paper, Sec. 3.2), by a scorer whose scores are probabilities.
    """
    localization_map = showcase.localization_map
    locations = showcase.grid.centers()[np.intersect1d(showcase.layer(), showcase.free)]
    kept = _survey(showcase, locations).best
    looking = poses_looking_along(np.repeat(locations, kept.shape[1], axis=0), showcase.directions[kept.ravel()])
    scores = scorer.score(looking).reshape(kept.shape)
    best = np.take_along_axis(kept, scores.argmax(1)[:, None], axis=1)[:, 0]
    candidates = showcase.viewpoints(location_id)
    candidate_scores = scorer.score(poses(candidates))
    row = int(np.argmax(candidate_scores))
    chosen = poses(candidates.iloc[[row]])
    seen = np.zeros(len(localization_map.landmarks), dtype=bool)
    seen[localization_map.landmarks_in_view(chosen)[0]] = True
    return Pipeline(
        house=showcase.house,
        landmarks=localization_map.landmarks.points,
        mapping_poses=np.zeros((0, 3, 4)) if localization_map.mapping_poses is None else localization_map.mapping_poses,
        camera=showcase.camera,
        locations=locations,
        n_locations=len(showcase.free),
        n_directions=len(showcase.directions),
        best_axes=showcase.directions[best],
        best_scores=scores.max(1),
        chosen=chosen[0],
        chosen_score=float(candidate_scores[row]),
        seen=seen,
        rgb=showcase.render(chosen)[0],
        outcome=outcome_in_words(candidates.iloc[row]),
    )


def sampling_of(showcase: Showcase, location_id: int) -> Sampling:
    """Return the layer of voxels of a location, and the landmarks visible and unoccluded from there."""
    localization_map = showcase.localization_map
    place = showcase.center(location_id)
    nz = showcase.grid.shape[2]
    layer = np.arange(location_id % nz, len(showcase.grid), nz)
    in_view = _survey(showcase, place[None])
    kept = np.zeros(len(showcase.directions), dtype=bool)
    best = in_view.best[0]
    kept[best[in_view.counts[0, best] > 0]] = True
    return Sampling(
        plan=showcase.plan,
        grid=showcase.grid,
        layer=layer,
        free=np.isin(layer, showcase.free),
        place=place,
        directions=showcase.directions,
        n_visible=in_view.counts[0].astype(np.int64),
        kept=kept,
        landmarks=localization_map.landmarks.points,
        unoccluded=localization_map.occlusion.unoccluded(place[None], localization_map.landmarks.points)[0],
    )


def binned_image_of(showcase: Showcase, cam_from_world: ArrayLike, bins: int = 30) -> BinnedImage:
    """Render and bin the view of a pose cam_from_world (3, 4)."""
    localization_map = showcase.localization_map
    pose = np.asarray(cam_from_world, dtype=np.float64)[None]
    points = localization_map.landmarks.points[localization_map.landmarks_in_view(pose)[0]]
    pixels = pixels_of(showcase.camera, points @ pose[0, :, :3].T + pose[0, :, 3])
    binned = localization_map.bin_views(pose, bins)
    empty = binned.counts[0] == 0
    means = {name: np.where(empty, np.nan, binned.means[0, row]) for row, name in enumerate(CHANNELS)}
    return BinnedImage(showcase.render(pose)[0], pixels, means, binned.counts[0])


def learning_of(showcase: Showcase, scorer: BinnedNetworkScorer, location_id: int, best: bool = True) -> Learning:
    """Return the activations of the paper's network for the best, or the worst, labelled view of a location."""
    from wheretolook_paper.release.mlp_architecture import activations

    candidates = showcase.viewpoints(location_id)
    row = int((np.argmax if best else np.argmin)(scorer.score(poses(candidates))))
    pose = poses(candidates.iloc[[row]])
    spec = scorer.network.spec
    found = activations(scorer.network, showcase.localization_map.bin_views(pose, spec.bins))
    image = binned_image_of(showcase, pose[0], spec.bins)
    return Learning(image, tuple(found), spec.channels, outcome_in_words(candidates.iloc[row], brief=True))


def mistaken_location(showcase: Showcase, scorer: Scorer) -> int:
    """Return the location at eye height with the largest mean difference between predictions and labels."""
    rows = showcase.table[showcase.table["location_id"].isin(showcase.layer())]
    error = pd.Series(np.abs(scorer.score(poses(rows)) - is_good(rows)), rows["location_id"])
    means = error.groupby(level=0).mean()
    return int(means.index[int(means.to_numpy().argmax())])


def peaks_of(showcase: Showcase, scorer: Scorer, location_id: int, n: int = 3) -> Peaks:
    """Return the scores of all directions at a location, and its n labelled views with the highest and lowest scores.

    Scores must be probabilities.
    """
    rows = showcase.viewpoints(location_id)
    looked = poses(rows)
    scores = scorer.score(poses(rows))
    axes = looked[:, 2, :3]

    def views(highest: bool) -> tuple[View, ...]:
        found = spread_extrema(axes, scores, n, highest=highest)
        return rendered_views(showcase, rows.iloc[found], scores[found], partial(outcome_in_words, brief=True))

    known = (rows["status"] != UNLABELLED).to_numpy()
    center = np.broadcast_to(showcase.center(location_id), showcase.directions.shape)
    everywhere = scorer.score(poses_looking_along(center, showcase.directions))
    tried = axes[known], is_good(rows[known])
    return Peaks(showcase.directions, everywhere, views(True), views(False), tried)


def planned_views(
    showcase: Showcase,
    dataset: Dataset,
    methods: Sequence[str] = PathsConfig.methods,
    config: PlanConfig = PlanConfig(grid=(8, 8, 4), directions=200),
) -> dict[str, Views]:
    """Return the views along several methods' paths between the farthest of ten random pairs."""
    pairs = draw_pairs(showcase.space, PathsConfig(pairs=10))
    start, goal = pairs[np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1).argmax()]
    paths = plan_by_methods(showcase, dataset, methods, start, goal, config)
    return {name: path_views(path, showcase.localization_map) for name, path in paths.items()}


def _survey(showcase: Showcase, locations: Float) -> Survey:
    rotations = rotation_looking_along(showcase.directions)
    points = showcase.landmarks.points
    options = SurveyOptions(keep=showcase.keep, keep_occlusion=False, device=showcase.device)
    return survey(showcase.camera, rotations, locations, points, showcase.occlusion, options)
