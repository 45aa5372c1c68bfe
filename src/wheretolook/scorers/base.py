"""What every method of scoring viewpoints has in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera, describe_camera
from wheretolook.geometry.poses import Float, check_poses, poses_looking_along
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS
from wheretolook.utils.errors import CameraError

if TYPE_CHECKING:
    from wheretolook.inputs.bins import BinnedViews
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.visibility.frustum import LandmarkSets

BLOCK = 4096  # views scored at a time: about 80 MB of bins
FIELD_OF_VIEW_TOLERANCE = (
    1e-3  # relative difference in size / focal length, and of the principal point, up to which they are the same
)


@dataclass(frozen=True, eq=False)
class ViewReport:
    """What a scorer tells of B views."""

    score: Float  # (B,)
    expected_inliers: Float  # (B,) landmarks expected to be found; NaN where the method does not tell
    n_visible: NDArray[np.int64]  # (B,) landmarks in view
    in_range: NDArray[np.bool_]  # (B,) whether the view is like those that the scorer has learnt from


@dataclass(frozen=True, eq=False)
class LandmarkProbabilities:
    """E visible landmarks of some views, one view after the other."""

    rows: NDArray[np.int64]  # (E,) of the landmarks in the map
    p_detect: Float  # (E,) probability that the localizer detects the landmark: matches it as an inlier
    precision: Float  # (E,) one over the variance of its bearing


class Scorer(ABC):
    """A method that says how well a camera would localize: the paper's f_P(R, t) -> [0, 1].

    A scorer is built from a map, the camera that will look, and whatever else the method needs. It answers for any
    batch of poses. The score of a pose depends on the pose alone: not on its place in the batch, nor on the other
    poses; the same scorer gives the same scores to the same poses. Higher is better. Scores lie in [0, 1] where the
    method allows; only their order counts for choosing a view.

    A new method is one file with a subclass and a record (`wheretolook.scorers.method.Method`), named in
    `registry.MODULES`. One that needs binned landmarks derives from `BinnedScorer` instead.
    """

    name: str
    local: bool = False

    def __init__(self, localization_map: LocalizationMap) -> None:
        self.localization_map = localization_map

    @abstractmethod
    def score(self, cam_from_world: Float) -> Float:
        """Score poses (B, 3, 4). Returns (B,) float64, finite. Raises PoseError if a pose is not finite."""

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Which poses (B, 3, 4) see what is like the views that the scorer has learnt from, (B,) bool.

        All do where nothing was learnt, or nothing is known of the views it was learnt from.
        """
        return np.ones(len(check_poses(cam_from_world)), dtype=bool)

    def score_around(self, locations: Float, directions: Float) -> Float:
        """Scores (L, D) of cameras without roll at locations (L, 3) m that look along each of directions (D, 3).

        They rank the directions of a location; what stands on samples of landmarks may differ from `score` by little.
        """
        at = np.repeat(locations, len(directions), axis=0)
        axes = np.tile(directions, (len(locations), 1))
        return self.score(poses_looking_along(at, axes)).reshape(len(locations), len(directions))

    def report(self, cam_from_world: Float) -> ViewReport:
        """Score poses (B, 3, 4), and tell what there is to know of them."""
        starts, _ = self.localization_map.in_view_on_device(cam_from_world)
        n_visible = np.diff(starts)
        expected = self.expected_inliers(cam_from_world)
        return ViewReport(self.score(cam_from_world), expected, n_visible, self.in_range(cam_from_world))

    def expected_inliers(self, cam_from_world: Float) -> Float:
        """How many landmarks poses (B, 3, 4) can be expected to find, (B,); NaN where the method does not tell."""
        return np.full(len(cam_from_world), np.nan)

    def landmark_probabilities(
        self, cam_from_world: Float, visible: LandmarkSets | None = None
    ) -> LandmarkProbabilities | None:
        """Return how likely each landmark visible from poses (B, 3, 4) is to be detected; None if that is unknown.

        `visible` are the landmarks to consider of each view, in place of all that are visible.
        """
        return None

    def score_binned(self, cam_from_world: Float, binned: BinnedViews) -> Float:
        """What `score` gives, (B,), for poses that the map's `bin_views` has binned already, with all `CHANNELS`."""
        return self.score(cam_from_world)


class BinnedScorer(Scorer):
    """Scores a view by its binned landmarks alone: `CHANNELS` or `ALL_CHANNELS` of `bins` x `bins` bins."""

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
        """Score binned views; views with another number of bins, or without channels it needs, are binned again."""
        wanted = ALL_CHANNELS if self.landmark_channels else CHANNELS
        if binned.counts.shape[-1] != self.bins or not {*wanted} <= {*binned.channels}:
            return self.score(cam_from_world)
        return self.score_bins(binned)

    @abstractmethod
    def score_bins(self, binned: BinnedViews) -> Float:
        """Score binned views with all channels that it asks for. Returns (B,) float64, finite."""


class CountingScorer(BinnedScorer):
    """A method that scores a view by how many landmarks and filled bins there are."""

    def score(self, cam_from_world: Float) -> Float:
        """Score poses (B, 3, 4). Returns (B,) float64."""
        return self.score_counts(*self.localization_map.count_bins(cam_from_world, self.bins))

    def score_bins(self, binned: BinnedViews) -> Float:
        """Score binned views (B,)."""
        return self.score_counts(binned.n_visible, binned.n_filled)

    @abstractmethod
    def score_counts(self, n_visible: NDArray[np.int32], n_filled: NDArray[np.int32]) -> Float:
        """Score views by their landmarks and filled bins, (B,) each. Returns (B,) float64, finite."""


def check_field_of_view(trained: Camera | None, camera: Camera) -> Camera:
    """The camera of the training views; a CameraError if its field of view is not that of the camera that looks."""
    if trained is None or not same_field_of_view(trained, camera):
        of = "several cameras" if trained is None else f"a camera of {describe_camera(trained)}"
        fix = "Use a pinhole camera with that field of view, or train with this one."
        raise CameraError(f"the network was trained for {of}", value=describe_camera(camera), fix=fix)
    return trained


def same_field_of_view(trained: Camera, camera: Camera) -> bool:
    """Whether two pinholes see the same: their image is the same but for its resolution."""
    if isinstance(camera, ColmapCamera) or isinstance(trained, ColmapCamera):
        return False
    spans = [(c.width / c.fx, c.height / c.fy, c.cx / c.width, c.cy / c.height) for c in (trained, camera)]
    return bool(np.allclose(spans[0], spans[1], rtol=FIELD_OF_VIEW_TOLERANCE, atol=0))
