"""The local origin of a scene: single precision measures from there, as coordinates may be those of a national grid.

At 5,000 km from the origin, neighbouring numbers of single precision lie half a metre apart; within 100 m of a local
origin, less than a hundredth of a millimetre.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float

STEP_M = 100.0


def local_origin(points: ArrayLike) -> Float:
    """Whole hundreds of metres near the median of the finite ones of points (N, 3) m, (3,): 0 for most scenes."""
    at = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    at = at[np.isfinite(at).all(1)]
    center = np.median(at, axis=0) if len(at) else np.zeros(3)
    return np.asarray(np.round(center / STEP_M) * STEP_M + 0.0)  # no -0.0


def poses_from(cam_from_world: ArrayLike, origin: ArrayLike) -> Float:
    """Transform poses (..., 3, 4) to a world whose origin is at `origin` (3,) m of theirs; minus the origin undoes it."""
    poses = np.array(cam_from_world, dtype=np.float64)
    poses[..., 3] += poses[..., :3] @ np.asarray(origin, dtype=np.float64)
    return poses
