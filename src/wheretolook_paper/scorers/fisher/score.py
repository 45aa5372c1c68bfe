"""Scores by the Fisher information of the pose, and by probes of the Fisher Information Field."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float, check_poses, split_poses
from wheretolook.inputs.localization_map import LocalizationMap, shared_locations
from wheretolook.scorers.base import Scorer
from wheretolook.visibility.frustum import LandmarkSets, PosedViews
from wheretolook_paper.fisher import soft_visibility
from wheretolook_paper.fisher.exact import exact_information
from wheretolook_paper.fisher.field import FisherField, stationary_axis_of_trace, worst_axis_of_trace
from wheretolook_paper.fisher.metrics import eigenvalues, metric_of, metric_of_eigenvalues
from wheretolook_paper.scorers.fisher import Approximation


class PoseInformation:
    """Information of the views of a map, shared by all of its scorers."""

    _of_maps: ClassVar[WeakKeyDictionary[LocalizationMap, PoseInformation]] = WeakKeyDictionary()

    def __init__(self, localization_map: LocalizationMap) -> None:
        # not the map itself: a value that refers to its key would keep both alive
        self.points = localization_map.landmarks.points
        self.camera = localization_map.camera
        self.occlusion = localization_map.occlusion
        self.device = localization_map.device
        half_angle = soft_visibility.cone_half_angle(self.camera)
        self.visibilities: dict[str, soft_visibility.SoftVisibility] = {
            "quadratic": soft_visibility.QuadraticVisibility(half_angle),
            "gp": soft_visibility.GaussianProcessVisibility.fitted(half_angle),
        }
        self._poses: Float = np.empty((0, 3, 4))
        self._known: dict[str, Any] = {}

    @classmethod
    def of_map(cls, localization_map: LocalizationMap) -> PoseInformation:
        """Return the information of a map's views, made once per map."""
        if localization_map not in cls._of_maps:
            cls._of_maps[localization_map] = cls(localization_map)
        return cls._of_maps[localization_map]

    def numbers(self, cam_from_world: Float, approximation: Approximation) -> Float:
        """Return the information (B, 15) of poses (B, 3, 4), see `wheretolook.geometry.pose_information`."""
        self._look_at(cam_from_world)
        return np.asarray(self._cached(approximation, lambda: self._numbers(approximation)))

    def eigenvalues(self, cam_from_world: Float, approximation: Approximation, about_origin: bool) -> Float:
        """Return the eigenvalues (B, 6) of the information of poses (B, 3, 4)."""
        numbers = self.numbers(cam_from_world, approximation)
        pivots = -split_poses(self._poses)[1] if about_origin else None
        name = f"{approximation} eigenvalues about {'the origin' if about_origin else 'the camera'}"
        return np.asarray(self._cached(name, lambda: eigenvalues(numbers, pivots, self.device)))

    def field(self, cam_from_world: Float, approximation: Approximation) -> tuple[FisherField, NDArray[np.int64]]:
        """Return the field at the locations of poses (B, 3, 4), and each pose's row in it, (B,)."""
        self._look_at(cam_from_world)
        locations, rows, mask = self._locations()
        inputs = (locations, self.points, self.visibilities[approximation], mask, self.device)
        field: FisherField = self._cached(f"{approximation} field", lambda: FisherField.build(*inputs))
        return field, rows

    def _cached(self, name: str, compute: Callable[[], Any]) -> Any:
        if name not in self._known:
            self._known[name] = compute()
        return self._known[name]

    def _look_at(self, cam_from_world: Float) -> None:
        poses = check_poses(cam_from_world)
        if not np.array_equal(poses, self._poses):  # several methods score the same block of views
            self._poses = poses.copy()
            self._known = {}

    def _locations(self) -> tuple[Float, NDArray[np.int64], NDArray[np.bool_]]:
        """Return locations (L, 3) of the poses, each pose's row, and the mask (L, N) of unoccluded landmarks."""
        locations, rows = self._cached("locations", lambda: shared_locations(self._poses))
        return locations, rows, self._cached("mask", lambda: self.occlusion.unoccluded(locations, self.points))

    def _numbers(self, approximation: Approximation) -> Float:
        if approximation != "exact":
            field, rows = self.field(self._poses, approximation)
            return field.information_of_views(rows, self._poses[:, 2, :3])
        _, rows, mask = self._locations()
        seen = LandmarkSets.from_mask(mask)
        return exact_information(PosedViews(self.camera, self._poses, self.points, seen, rows), self.device)


class FisherScorer(Scorer):
    """Scores a view by a metric ("mineig", "logdet" or "trace") of the information on its pose.

    The approximation "exact" sums over the landmarks in view; "quadratic" (10 factors) and "gp" (70) over all that have
    a free line of sight, weighted by a soft visibility of the optical axis, as a field stores them.

    With `about_origin`, rotations are about the world's origin, as in the released code of the Fisher Information
    Field, instead of about the camera. The determinant is the same. The camera is the default because it gives better
    rows of the paper's table on the validation scene.
    """

    def __init__(
        self,
        localization_map: LocalizationMap,
        metric: str = "mineig",
        approximation: Approximation = "exact",
        about_origin: bool = False,
    ) -> None:
        super().__init__(localization_map)
        self.metric = metric
        self.approximation = approximation
        self.about_origin = about_origin
        self.name = f"fisher-{metric}-{approximation}" + ("-origin" if about_origin else "")
        self._information = PoseInformation.of_map(localization_map)

    def score(self, cam_from_world: Float) -> Float:
        """Return (B,), not bounded by 1."""
        if self.metric == "trace" and not self.about_origin:
            return metric_of(self._information.numbers(cam_from_world, self.approximation), "trace")
        values = self._information.eigenvalues(cam_from_world, self.approximation, self.about_origin)
        return metric_of_eigenvalues(values, self.metric)


class ProbeScorer(Scorer):
    """Scores a view by the angle between its axis and a certain axis of its location."""

    def __init__(self, localization_map: LocalizationMap) -> None:
        super().__init__(localization_map)
        self._information = PoseInformation.of_map(localization_map)

    def score(self, cam_from_world: Float) -> Float:
        """Return (B,) in [0, 1]: half of one plus the cosine between the two axes."""
        cam_from_world = check_poses(cam_from_world)
        field, rows = self._information.field(cam_from_world, "quadratic")
        axes = np.array([self.axis(field, row) for row in range(len(field.locations))]).reshape(-1, 3)
        cosines = np.einsum("bi,bi->b", cam_from_world[:, 2, :3], axes[rows])
        return np.asarray((1 + cosines) / 2)

    @abstractmethod
    def axis(self, field: FisherField, row: int) -> Float:
        """Return the axis (3,) at location `row`."""


class WorstTraceScorer(ProbeScorer):
    """The view with the smallest trace by the quadratic field ("trace app worst")."""

    name = "fisher-worst-trace"

    def axis(self, field: FisherField, row: int) -> Float:
        """Return the axis (3,)."""
        return worst_axis_of_trace(field, row, fibonacci_sphere(2000))  # axes among which the worst view is sought


class StationaryTraceScorer(ProbeScorer):
    """The stationary point of the quadratic field's trace ("trace app zero deriv"), which is its minimum's side."""

    name = "fisher-stationary-trace"

    def axis(self, field: FisherField, row: int) -> Float:
        """Return the axis (3,)."""
        return stationary_axis_of_trace(field, row)
