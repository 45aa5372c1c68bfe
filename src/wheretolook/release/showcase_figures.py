"""What the figures of one scene draw, taken from a `wheretolook.release.showcase.Showcase`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.folders import Dataset
from wheretolook.figures.inputs import BinnedImage
from wheretolook.figures.overview import View
from wheretolook.figures.peaks import spread_extrema
from wheretolook.figures.pipeline import Pipeline
from wheretolook.figures.sampling import Sampling
from wheretolook.geometry.poses import Float, poses_looking_along, rotation_looking_along
from wheretolook.inputs.channels import CHANNELS
from wheretolook.methods.base import Scorer
from wheretolook.methods.binned_network import BinnedNetworkScorer
from wheretolook.planning.config import PathsConfig, PlanConfig
from wheretolook.planning.method_paths import path_views, plan_by_methods
from wheretolook.planning.path_comparison import draw_pairs
from wheretolook.planning.path_view import PathView
from wheretolook.planning.refine import score_directions
from wheretolook.release.showcase import EYE_M, Showcase
from wheretolook.utils.errors import ConfigError
from wheretolook.viewpoints.table import UNLABELLED, is_good, outcome_in_brief, outcome_in_words, poses
from wheretolook.visibility.frustum import pixels_of
from wheretolook.visibility.survey import Survey, survey


@dataclass(frozen=True, eq=False)
class Peaks:
    """What `wheretolook.figures.peaks.peaks_figure` draws; see there."""

    directions: Float
    scores: Float
    peaks: tuple[View, ...]
    pits: tuple[View, ...]
    tried: tuple[Float, NDArray[np.bool_]]

    @property
    def drawn(self) -> tuple[Any, ...]:
        """Arguments of `peaks_figure`."""
        return self.directions, self.scores, self.peaks, self.pits, self.tried


@dataclass(frozen=True, eq=False)
class Learning:
    """What `wheretolook.figures.learning.learning_figure` draws; see there."""

    image: BinnedImage
    activations: tuple[Float, ...]
    channels: tuple[str, ...]
    outcome: str

    @property
    def drawn(self) -> tuple[Any, ...]:
        """Arguments of `learning_figure`."""
        return self.image, self.activations, self.channels, self.outcome


def pipeline_of(showcase: Showcase, scorer: Scorer, location_id: int, height_m: float = EYE_M) -> Pipeline:
    """From the scene's map to the best labelled view of a location.

    Of each location the K directions are scored that see most landmarks (paper, Sec. 3.2).

    Args:
        showcase: the scene.
        scorer: whose scores are probabilities.
        location_id: where the camera stands that is to be turned.
        height_m: of the layer of locations that is shown, above the floor.
    """
    one = showcase.localization_map
    locations = showcase.grid.centers()[np.intersect1d(showcase.layer(height_m), showcase.free)]
    kept = _survey(showcase, locations).best
    looking = poses_looking_along(np.repeat(locations, kept.shape[1], axis=0), showcase.directions[kept.ravel()])
    scores = scorer.score(looking).reshape(kept.shape)
    best = np.take_along_axis(kept, scores.argmax(1)[:, None], axis=1)[:, 0]
    candidates = showcase.viewpoints(location_id)
    candidate_scores = scorer.score(poses(candidates))
    row = int(np.argmax(candidate_scores))
    chosen = poses(candidates.iloc[[row]])
    seen = np.zeros(len(one.landmarks), dtype=bool)
    seen[one.visible_landmarks(chosen)[0]] = True
    mapping_poses = np.zeros((0, 3, 4)) if one.mapping_poses is None else one.mapping_poses
    return Pipeline(
        showcase.house, one.landmarks.points, mapping_poses, showcase.camera, locations, len(showcase.free),
        len(showcase.directions), showcase.directions[best], scores.max(1), chosen[0], float(candidate_scores[row]),
        seen, showcase.render(chosen)[0], outcome_in_words(candidates.iloc[row]),
    )  # fmt: skip


def sampling_of(showcase: Showcase, location_id: int) -> Sampling:
    """The layer of voxels that holds a location, and what the location sees."""
    one, place = showcase.localization_map, showcase.center(location_id)
    nz = showcase.grid.shape[2]
    ids = np.arange(len(showcase.grid))
    layer = ids[ids % nz == location_id % nz]
    seen = _survey(showcase, place[None])
    kept = np.zeros(len(showcase.directions), dtype=bool)
    best = seen.best[0]
    kept[best[seen.counts[0, best] > 0]] = True
    unoccluded = one.occlusion.unoccluded(place[None], one.landmarks.points)[0]
    return Sampling(
        showcase.plan, showcase.grid, layer, np.isin(layer, showcase.free), place, showcase.directions,
        seen.counts[0].astype(np.int64), kept, one.landmarks.points, unoccluded,
    )  # fmt: skip


def binned_image_of(showcase: Showcase, cam_from_world: ArrayLike, bins: int = 30) -> BinnedImage:
    """One view (3, 4), rendered and binned."""
    one, pose = showcase.localization_map, np.asarray(cam_from_world, dtype=np.float64)[None]
    points = one.landmarks.points[one.visible_landmarks(pose)[0]]
    pixels = pixels_of(showcase.camera, points @ pose[0, :, :3].T + pose[0, :, 3])
    binned = one.bin_views(pose, bins)
    empty = binned.counts[0] == 0
    means = {name: np.where(empty, np.nan, binned.means[0, row]) for row, name in enumerate(CHANNELS)}
    return BinnedImage(showcase.render(pose)[0], pixels, means, binned.counts[0])


def learning_of(showcase: Showcase, scorer: BinnedNetworkScorer, location_id: int, best: bool = True) -> Learning:
    """What the paper's network makes of the labelled view of a location that it scores highest, or else lowest."""
    from wheretolook.methods.mlp.architecture import activations

    candidates = showcase.viewpoints(location_id)
    row = int((np.argmax if best else np.argmin)(scorer.score(poses(candidates))))
    pose = poses(candidates.iloc[[row]])
    spec = scorer.network.spec
    found = activations(scorer.network, showcase.localization_map.bin_views(pose, spec.bins))
    image = binned_image_of(showcase, pose[0], spec.bins)
    return Learning(image, tuple(found), spec.channels, outcome_in_brief(candidates.iloc[row]))


def mistaken_location(showcase: Showcase, scorer: Scorer, height_m: float = EYE_M) -> int:
    """The location of a layer whose predicted probabilities are farthest from the labels, on average.

    Raises:
        ConfigError: the layer has no viewpoint.
    """
    rows = showcase.table[showcase.table["location_id"].isin(showcase.layer(height_m))]
    if len(rows) == 0:
        raise ConfigError("no viewpoint was sampled at this height", value=height_m, fix="Take another.")
    off = np.abs(scorer.score(poses(rows)) - is_good(rows))
    ids, group = np.unique(rows["location_id"].to_numpy(np.int64), return_inverse=True)
    return int(ids[np.argmax(np.bincount(group, weights=off) / np.bincount(group))])


def peaks_of(showcase: Showcase, scorer: Scorer, location_id: int, n: int = 3, apart_deg: float = 40.0) -> Peaks:
    """The scores of every direction at a location, and its labelled views with the highest and the lowest of them.

    Args:
        showcase: the scene.
        scorer: whose scores are probabilities.
        location_id: one with viewpoints.
        n: peaks, and as many pits.
        apart_deg: least angle between two peaks, and between two pits.
    """
    rows = showcase.viewpoints(location_id)
    looked, scores = poses(rows), scorer.score(poses(rows))
    axes = looked[:, 2, :3]

    def views(highest: bool) -> tuple[View, ...]:
        found = spread_extrema(axes, scores, n, apart_deg, highest)
        shown = zip(showcase.render(looked[found]), found, strict=True)
        return tuple(View(rgb, axes[row], float(scores[row]), outcome_in_brief(rows.iloc[row])) for rgb, row in shown)

    known = (rows["status"] != UNLABELLED).to_numpy()
    everywhere = score_directions(scorer, showcase.center(location_id), showcase.directions)[0]
    tried = axes[known], is_good(rows[known])
    return Peaks(showcase.directions, everywhere, views(True), views(False), tried)


PLANNED_BY = ("forward", "fisher-trace-gp", "set")
"""Methods of the paper's planning figure."""


def planned_views(
    showcase: Showcase,
    dataset: Dataset,
    methods: Sequence[str] = PLANNED_BY,
    config: PlanConfig = PlanConfig(grid=(8, 8, 4), directions=200),
) -> dict[str, list[PathView]]:
    """What a camera sees along the paths of several methods, between a start and a goal: the farthest of ten pairs.

    Args:
        showcase: the scene.
        dataset: it is of; its weights are used.
        methods: names on the command line.
        config: grid and directions of the viewpoint maps, and of the paths.
    """
    one = showcase.localization_map
    pairs = draw_pairs(showcase.space, PathsConfig(pairs=10))
    start, goal = pairs[np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1).argmax()]
    paths = plan_by_methods(
        methods, start, goal, showcase.scene, dataset, showcase.space, one.occlusion, config=config, device=one.device
    )
    return {name: path_views(path, one) for name, path in paths.items()}


def _survey(showcase: Showcase, locations: Float) -> Survey:
    one = showcase.localization_map
    rotations = rotation_looking_along(showcase.directions)
    return survey(showcase.camera, rotations, locations, one.landmarks.points, one.occlusion, keep=showcase.keep,
                  keep_occlusion=False, device=one.device)  # fmt: skip
