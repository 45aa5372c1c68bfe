"""What all who look share: the opened map, what was computed of it, and the thread that computes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import WhereToLookError
from wheretolook.view.drawing import mesh_glb, size_of
from wheretolook.view.opened import Opened, centers_of
from wheretolook.view.paths import Paths
from wheretolook.view.scores import FLOOR_DIRECTIONS, Floor, floor_at, heights_of
from wheretolook.view.worker import Worker

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer
    from wheretolook.select.where_to_look import WhereToLook

KEPT_FLOORS = 64
KEPT_MESHES = 4
STEP_M = 0.05  # heights of floors and cuts are multiples of this

T = TypeVar("T")


class Shared:
    """Made once. `floor`, `look` and `teller` are for the thread that computes alone."""

    def __init__(self, opened: Opened, paths: Paths | None = None) -> None:
        self.opened = opened
        self.paths = paths or {}
        self.worker = Worker()
        self.low_m, self.high_m, self.usual_m = heights_of(opened.space, centers_of(opened))
        self.size_m = size_of(opened.landmarks.points)
        self.doubts = opened.doubts
        self._floors: OrderedDict[tuple[str, str, float], Floor] = OrderedDict()
        self._meshes: OrderedDict[float | None, bytes] = OrderedDict()
        self._lock = Lock()

    @property
    def seen_box(self) -> Float:
        """The box (2, 3) m around the landmarks, without outliers, and all of the floor, that a page begins with."""
        low, high = np.quantile(self.opened.landmarks.points, (0.02, 0.98), axis=0)
        lower, upper = np.array(self.opened.space.bounds, dtype=np.float64)
        lower[2] = upper[2] = self.usual_m
        return np.stack([np.minimum(low, lower), np.maximum(high, upper)])

    @property
    def mark_m(self) -> float:
        """How large things are drawn in a scene of this size, metres."""
        return min(0.3, 0.03 * self.size_m)

    def is_probability(self, method: str) -> bool:
        """Whether a method's scores are probabilities, so that a threshold says something."""
        from wheretolook.scorers.registry import find

        known = find(method)
        return known is not None and known.probability

    def look(self, method: str, occlusion: str) -> WhereToLook:
        """As `Opened.look`."""
        return self.opened.look(method, occlusion)

    def floor(self, method: str, occlusion: str, height_m: float) -> tuple[Floor, WhereToLook]:
        """A floor, the same for all who ask, and what scores its places."""
        look = self.opened.look(method, occlusion, FLOOR_DIRECTIONS)
        key = (method, occlusion, round(height_m / STEP_M) * STEP_M)
        hides = look.localization_map.occlusion
        return _kept(self._floors, key, KEPT_FLOORS, lambda: floor_at(self.opened.space, hides, key[2])), look

    def mesh(self, cut_m: float | None) -> bytes | None:
        """The mesh below a height as a GLB file, None without a mesh; for any thread."""
        if self.opened.mesh is None:
            return None
        mesh = self.opened.mesh
        key = None if cut_m is None else round(cut_m / STEP_M) * STEP_M
        with self._lock:
            return _kept(self._meshes, key, KEPT_MESHES, lambda: mesh_glb(mesh, key))

    def teller(self, occlusion: str) -> Scorer | None:
        """What tells landmarks' chances of being found where the method does not: the best weights, if they can."""
        try:
            return self.opened.look("", occlusion).scorer
        except WhereToLookError:
            return None


def _kept(known: OrderedDict, key: object, most: int, make: Callable[[], T]) -> T:  # type: ignore[type-arg]
    """A value that is made once, of which those used last are kept."""
    if key not in known:
        known[key] = make()
        while len(known) > most:
            known.popitem(last=False)
    known.move_to_end(key)
    found: T = known[key]
    return found
