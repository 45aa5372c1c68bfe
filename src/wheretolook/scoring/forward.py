"""The camera looks where the robot goes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry import Float
from wheretolook.localization_map import LocalizationMap
from wheretolook.rendering.types import check_poses
from wheretolook.scoring.base import Scorer


class ForwardScorer(Scorer):
    """Views by how near they look to a heading: the classical camera that knows nothing of the map (paper, Sec. 4.3).

    Args:
        localization_map: not looked at.
        heading: (3,) in the world, of any length but zero: where the robot drives to.

    Raises:
        ValueError: the heading is zero or not finite.
    """

    name: ClassVar[str] = "forward"

    def __init__(self, localization_map: LocalizationMap, heading: ArrayLike = (1.0, 0.0, 0.0)) -> None:
        super().__init__(localization_map)
        heading = np.asarray(heading, dtype=np.float64)
        length = float(np.linalg.norm(heading))
        if heading.shape != (3,) or not 0 < length < np.inf:
            raise ValueError(f"a heading is a direction (3,) of finite length, got {heading}")
        self.heading = heading / length

    def score(self, cam_from_world: Float) -> Float:
        """(B,) in [0, 1]: half of one plus the cosine between optical axis and heading."""
        return np.asarray((1 + np.clip(check_poses(cam_from_world)[:, 2, :3] @ self.heading, -1, 1)) / 2)
