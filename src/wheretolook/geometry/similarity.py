"""Similarity transformations, and a local origin that keeps coordinates small."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float, as_points


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation x + translation; by default the identity."""

    scale: float = 1.0  # positive
    rotation: Float = field(default_factory=lambda: np.eye(3))
    translation: Float = field(default_factory=lambda: np.zeros(3))  # (3,), in units of the target

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Transform points (..., 3)."""
        return np.asarray(self.scale * np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation)

    def apply_to_poses(self, poses: ArrayLike) -> NDArray[np.float64]:
        """Convert poses (..., 3, 4) cam_from_source to cam_from_target."""
        poses = np.asarray(poses, dtype=np.float64)
        rotation = poses[..., :3] @ self.rotation.T
        translation = self.scale * poses[..., 3:] - rotation @ self.translation[:, None]
        return np.asarray(np.concatenate([rotation, translation], axis=-1))

    def record(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {"scale": self.scale, "rotation": self.rotation.tolist(), "translation": self.translation.tolist()}

    @property
    def inverse(self) -> Similarity:
        """The similarity from target to source."""
        return Similarity(1 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)

    def transform_model(self, model: Any) -> None:
        """Transform a `pycolmap.Reconstruction` in place."""
        import pycolmap

        model.transform(pycolmap.Sim3d(self.scale, pycolmap.Rotation3d(self.rotation), self.translation))


def local_origin(points: ArrayLike) -> Float:
    """Return the median (3,) of the finite points among (N, 3) m, rounded to 100 m: 0 for most scenes."""
    at = as_points(points)
    at = at[np.isfinite(at).all(1)]
    center = np.median(at, axis=0) if len(at) else np.zeros(3)
    return np.asarray(np.round(center / 100.0) * 100.0 + 0.0)  # no -0.0


def poses_from(cam_from_world: ArrayLike, origin: ArrayLike) -> Float:
    """Move the origin of the world of poses (..., 3, 4) to `origin` (3,) m; `-origin` is the inverse."""
    poses = np.array(cam_from_world, dtype=np.float64)
    poses[..., 3] += poses[..., :3] @ np.asarray(origin, dtype=np.float64)
    return poses
