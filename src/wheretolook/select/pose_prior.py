"""Expected scores of views where the robot's pose is uncertain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float
from wheretolook.scorers.base import Scorer

DRAWS = 32  # of the true pose, the same at each waypoint
ALTERNATIVES = 60  # directions with the best scores, which are compared


@dataclass(frozen=True)
class PosePrior:
    """Gaussian uncertainty of a robot's pose: of x and y each in metres, and of yaw in degrees; height is known."""

    sigma_m: float
    yaw_sigma_deg: float

    def draws(self) -> tuple[Float, Float]:
        """Return errors of position (DRAWS, 3) m and rotations about the vertical (DRAWS, 3, 3), in the world."""
        normal = np.random.default_rng(0).standard_normal((DRAWS, 3))
        offsets = normal * (self.sigma_m, self.sigma_m, 0.0)
        yaw = np.radians(self.yaw_sigma_deg) * normal[:, 2]
        rotations = np.tile(np.eye(3), (DRAWS, 1, 1))
        rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
        rotations[:, 1, 0] = np.sin(yaw)
        rotations[:, 0, 1] = -rotations[:, 1, 0]
        return offsets, rotations

    def expected_scores(
        self,
        scorer: Scorer,
        points: Float,
        axes: Float,
        allowed: NDArray[np.bool_],
        chosen: tuple[NDArray[np.int64], Float],
        progress: bool = False,
    ) -> tuple[Float, Float]:
        """Compute mean scores over draws of the true pose outside geometry, while the robot turns by its estimate.

        Args:
            scorer: scores views.
            points: (W, 3) m, estimated locations in the world.
            axes: (D, 3) directions scored at each.
            allowed: (W, D) those that are compared.
            chosen: rows of points (V,), and optical axes (V, 3), of the selected views.
            progress: show a bar.

        Returns:
            (V,) of each selected view, and (V,) the highest of all compared directions at its location.
        """
        of_view, view_axes = chosen
        expected, best = np.empty(len(of_view)), np.empty(len(of_view))
        offsets, rotations = self.draws()
        for row in tqdm(range(len(points)), desc="prior", unit="waypoint", disable=not progress):
            views = np.flatnonzero(of_view == row)
            directions = np.concatenate([view_axes[views], axes[allowed[row]]])
            at = points[row] + offsets
            free = ~scorer.localization_map.occlusion.inside_geometry(at)
            free |= ~free.any()
            pairs = zip(at[free], rotations[free], strict=True)
            scores = [scorer.score_directions(point[None], directions @ turn.T)[0] for point, turn in pairs]
            mean = np.mean(scores, axis=0)
            expected[views], best[views] = mean[: len(views)], mean.max()
        return expected, best
