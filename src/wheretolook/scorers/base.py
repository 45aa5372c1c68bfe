"""Base classes of all scorers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera, describe_camera
from wheretolook.geometry.poses import Float, check_poses, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS
from wheretolook.utils.errors import CameraError, ConfigError

if TYPE_CHECKING:
    from wheretolook.dataset.config import Accuracy
    from wheretolook.inputs.bins import BinnedViews
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.visibility.frustum import LandmarkSets

BLOCK = 4096  # views scored at a time: about 80 MB of bins


@dataclass(frozen=True, eq=False)
class LandmarkProbabilities:
    """E visible landmarks of some views, one view after the other."""

    rows: NDArray[np.int64]  # (E,) of the landmarks in the map
    p_detect: Float  # (E,) probability that the localizer detects the landmark: matches it as an inlier
    precision: Float  # (E,) one over the variance of its bearing


class Scorer(ABC):
    """Scores how well a camera would localize from a pose: the paper's f_P(R, t) -> [0, 1].

    A scorer is built from a localization map, with the camera to localize, and what else the method needs. The score of
    a pose depends on that pose alone, not on the batch, and is deterministic. Higher is better; scores are in [0, 1]
    where the method allows, but only their order matters for choosing a view.

    A new method is one file with a subclass and a record (`wheretolook.scorers.registry.Method`), named in
    `registry.MODULES`. One that needs binned landmarks derives from `BinnedScorer`.
    """

    name: str

    def __init__(self, localization_map: LocalizationMap) -> None:
        self.localization_map = localization_map

    @abstractmethod
    def score(self, cam_from_world: Float) -> Float:
        """Score poses (B, 3, 4). Returns (B,) float64, finite. Raises PoseError if a pose is not finite."""

    def at_accuracy(self, accuracy: Accuracy) -> Scorer:
        """Return a scorer whose scores are probabilities that errors are within limits in metres and degrees.

        In a map of unknown unit, metres are those of a median depth of 5 m. Raises a ConfigError unless the limits are
        positive and the method predicts this.
        """
        fix = "Use the method set and its weights, or leave the accuracy out."
        raise ConfigError("the scores of this method are not for any accuracy", value=self.name, fix=fix)

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Return which poses (B, 3, 4) have views in the range of the training views, (B,) bool; all if there is none."""
        return np.ones(len(check_poses(cam_from_world)), dtype=bool)

    def score_directions(self, locations: Float, directions: Float) -> Float:
        """Score cameras without roll at locations (L, 3) m along each of directions (D, 3). Returns (L, D).

        Methods that sample landmarks may differ slightly from `score`.
        """
        return self.score_and_count(locations, directions)[0]

    def score_and_count(self, locations: Float, directions: Float) -> tuple[Float, NDArray[Any] | None]:
        """Return `score_directions` and the landmarks in view, (L, D) each; None where the method does not count them."""
        at = np.repeat(locations, len(directions), axis=0)
        axes = np.tile(directions, (len(locations), 1))
        return self.score(poses_looking_along(at, axes)).reshape(len(locations), len(directions)), None

    def report(self, cam_from_world: Float) -> Views:
        """Score poses (B, 3, 4) and report what else is known of their views."""
        starts, _ = self.localization_map.in_view_on_device(cam_from_world)
        return Views(
            cam_from_world,
            self.localization_map.camera,
            self.name,
            score=self.score(cam_from_world),
            expected_inliers=self.expected_inliers(cam_from_world),
            n_visible=np.diff(starts),
            in_range=self.in_range(cam_from_world),
        )

    def expected_inliers(self, cam_from_world: Float) -> Float:
        """Return how many landmarks poses (B, 3, 4) are expected to detect, (B,); NaN if that is unknown."""
        return np.full(len(cam_from_world), np.nan)

    def landmark_probabilities(
        self, cam_from_world: Float, visible: LandmarkSets | None = None
    ) -> LandmarkProbabilities | None:
        """Return how likely each landmark visible from poses (B, 3, 4) is to be detected; None if that is unknown.

        `visible` are the landmarks to consider of each view, in place of all that are visible.
        """
        return None

    def score_binned(self, cam_from_world: Float, binned: BinnedViews) -> Float:
        """Return `score` (B,) of poses whose views are binned already, with all `CHANNELS`."""
        return self.score(cam_from_world)


class BinnedScorer(Scorer):
    """Scores a view from its landmarks in `bins` x `bins` bins, with `CHANNELS` or `ALL_CHANNELS`."""

    def __init__(self, localization_map: LocalizationMap, bins: int = 30, landmark_channels: bool = False) -> None:
        super().__init__(localization_map)
        self.bins = bins
        self.landmark_channels = landmark_channels

    def score(self, cam_from_world: Float) -> Float:
        """Score poses (B, 3, 4). Returns (B,) float64."""
        scores = np.empty(len(cam_from_world))
        for begin in range(0, len(scores), BLOCK):
            poses = cam_from_world[begin : begin + BLOCK]
            binned = self.localization_map.bin_views(poses, self.bins, self.landmark_channels)
            scores[begin : begin + BLOCK] = self.score_bins(binned)
        return scores

    def score_binned(self, cam_from_world: Float, binned: BinnedViews) -> Float:
        """Score binned views (B,); views with other bins, or without a channel it needs, are binned again."""
        wanted = ALL_CHANNELS if self.landmark_channels else CHANNELS
        if binned.counts.shape[-1] != self.bins or not {*wanted} <= {*binned.channels}:
            return self.score(cam_from_world)
        return self.score_bins(binned)

    @abstractmethod
    def score_bins(self, binned: BinnedViews) -> Float:
        """Score binned views with all of its channels. Returns (B,) float64, finite."""


class CountingScorer(BinnedScorer):
    """Scores a view by its numbers of landmarks and filled bins."""

    def score(self, cam_from_world: Float) -> Float:
        """Score poses (B, 3, 4). Returns (B,) float64."""
        return self.score_counts(*self.localization_map.count_bins(cam_from_world, self.bins))

    def score_bins(self, binned: BinnedViews) -> Float:
        """Score binned views (B,)."""
        return self.score_counts(binned.n_visible, binned.n_filled)

    @abstractmethod
    def score_counts(self, n_visible: NDArray[np.int32], n_filled: NDArray[np.int32]) -> Float:
        """Score views from their numbers of landmarks and filled bins, (B,) each. Returns (B,) float64, finite."""


def check_field_of_view(trained: Camera | None, camera: Camera) -> Camera:
    """Return the camera of the training views; a CameraError if its field of view is not that of `camera`."""
    if trained is None or not same_field_of_view(trained, camera):
        of = "several cameras" if trained is None else f"a camera of {describe_camera(trained)}"
        fix = "Use a pinhole camera with that field of view, or train with this one."
        raise CameraError(f"the network was trained for {of}", value=describe_camera(camera), fix=fix)
    return trained


def same_field_of_view(trained: Camera, camera: Camera) -> bool:
    """Return whether two pinhole cameras have the same field of view, up to resolution."""
    if isinstance(camera, ColmapCamera) or isinstance(trained, ColmapCamera):
        return False
    spans = [(c.width / c.fx, c.height / c.fy, c.cx / c.width, c.cy / c.height) for c in (trained, camera)]
    return bool(np.allclose(spans[0], spans[1], rtol=1e-3, atol=0))


def finite_log_odds(probability: ArrayLike, margin: float) -> NDArray[np.float64]:
    """Return log-odds (...,) of probabilities (...,) in [0, 1], clipped to `margin` .. 1 - `margin` so that they are finite."""
    clipped = np.clip(probability, margin, 1 - margin)
    return np.asarray(np.log(clipped) - np.log1p(-clipped))
