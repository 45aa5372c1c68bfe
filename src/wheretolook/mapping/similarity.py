"""The similarity between two sets of corresponding points, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import MapError

_FLAT = 1e-6  # points whose second largest spread is below this share of the largest lie on a line


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation x + translation."""

    scale: float  # positive
    rotation: Float  # (3, 3)
    translation: Float  # (3,), in units of the target

    def apply(self, points: ArrayLike) -> Float:
        """Transform points (..., 3)."""
        return np.asarray(self.scale * np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation)

    def transform_model(self, model: Any) -> None:
        """Transform a `pycolmap.Reconstruction` in place."""
        import pycolmap

        model.transform(pycolmap.Sim3d(self.scale, pycolmap.Rotation3d(self.rotation), self.translation))


def fit_similarity(source: ArrayLike, target: ArrayLike) -> Similarity:
    """The similarity that takes points (N, 3) to points (N, 3) with the least sum of squares.

    Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", TPAMI 1991.

    Raises:
        MapError: fewer than three points, or all on a line, which leaves the rotation about it open.
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if len(a) < 3:
        raise MapError("a similarity needs three points", value=len(a), fix="Give the positions of more photographs.")
    mean_a, mean_b = a.mean(0), b.mean(0)
    for points in (a - mean_a, b - mean_b):
        spread = np.linalg.svd(points, compute_uv=False)
        if spread[1] <= _FLAT * max(spread[0], 1e-12):
            fix = "Give positions that are not on a line."
            raise MapError("positions on one line do not fix a frame", value=len(a), fix=fix)
    u, singular, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / ((a - mean_a) ** 2).sum(1).mean())
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)
