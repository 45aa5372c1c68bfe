"""A small textured room whose free space is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from box_scenes import ROOM_SIZE, box_room


@dataclass(frozen=True)
class BoxFreeSpace:
    """Free space of an empty box, less `clearance_m`, less a solid column (2D rectangle) that reaches the ceiling."""

    size: tuple[float, float, float] = ROOM_SIZE
    clearance_m: float = 0.25
    column: tuple[tuple[float, float], tuple[float, float]] | None = None

    def is_free(self, points):
        points = np.asarray(points)
        free = ((points > self.clearance_m) & (points < np.array(self.size) - self.clearance_m)).all(1)
        if self.column is not None:
            low, high = np.array(self.column)
            free &= ((points[:, :2] < low) | (points[:, :2] > high)).any(1)
        return free

    def segments_are_free(self, a, b):
        steps = np.linspace(0, 1, 33)[:, None, None]
        points = np.asarray(a)[None] * (1 - steps) + np.asarray(b)[None] * steps
        return self.is_free(points.reshape(-1, 3)).reshape(points.shape[:2]).all(0)

    def floor_below(self, points):
        points = np.asarray(points)
        inside = ((points[:, :2] >= 0) & (points[:, :2] <= np.array(self.size)[:2]) & (points[:, 2:] >= 0)).all(1)
        return np.where(inside, 0.0, np.nan)


@pytest.fixture(scope="session")
def room():
    return box_room()


@pytest.fixture(scope="session")
def room_free_space():
    return BoxFreeSpace()
