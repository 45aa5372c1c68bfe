"""State shared by all clients: the map, computed floors and meshes, and the worker thread."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import WhereToLookError
from wheretolook.view.drawing import mesh_glb, scene_size
from wheretolook.view.paths import Paths
from wheretolook.view.scores import FLOOR_DIRECTIONS, Floor, floor_at, height_range
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import ViewedMap
from wheretolook.view.worker import Worker

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer
    from wheretolook.select.where_to_look import WhereToLook

MAX_FLOORS = 64
MAX_MESHES = 4
STEP_M = 0.05  # heights of floors and cuts are multiples of it

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Shared:
    """State shared by all clients. `floor` and `landmark_scorer` are for the worker thread only."""

    def __init__(self, viewed: ViewedMap, paths: Paths | None = None) -> None:
        self.viewed = viewed
        self.paths = paths or {}
        self.worker = Worker()
        self.low_m, self.high_m, self.usual_m = height_range(viewed.space, viewed.mapping_centers)
        self.size_m = scene_size(viewed.landmarks.points)
        self._floors: OrderedDict[tuple[str, str, float], Floor] = OrderedDict()
        self._meshes: OrderedDict[float | None, bytes] = OrderedDict()
        self._lock = Lock()

    @property
    def bounding_box(self) -> Float:
        """Box (2, 3) m around floor and landmarks without outliers, which a page shows at first."""
        low, high = np.quantile(self.viewed.landmarks.points, (0.02, 0.98), axis=0)
        lower, upper = np.array(self.viewed.space.bounds, dtype=np.float64)
        lower[2] = upper[2] = self.usual_m
        return np.stack([np.minimum(low, lower), np.maximum(high, upper)])

    @property
    def marker_m(self) -> float:
        """Size of drawn markers, metres."""
        return min(0.3, 0.03 * self.size_m)

    def is_probability(self, method: str) -> bool:
        """Test whether a method's scores are probabilities, which a threshold applies to."""
        from wheretolook.scorers.registry import find

        known = find(method)
        return known is not None and known.probability

    def complete(self, state: ViewState) -> ViewState:
        """Fill in method, occlusion model and height where a state leaves them open or they are not available."""
        viewed = self.viewed
        return replace(
            state,
            method=state.method if state.method in viewed.methods else viewed.methods[0],
            occlusion=state.occlusion if state.occlusion in viewed.occlusions else viewed.occlusions[0],
            height=self.usual_m if state.height is None else state.height,
        )

    def floor(self, method: str, occlusion: str, height_m: float) -> tuple[Floor, WhereToLook]:
        """Return the floor at a height, one object for all clients, and the selector that scores its cells."""
        selector = self.viewed.selector(method, occlusion, FLOOR_DIRECTIONS)
        model = selector.localization_map.occlusion
        key = (method, occlusion, round(height_m / STEP_M) * STEP_M)
        return _cached(self._floors, key, MAX_FLOORS, lambda: floor_at(self.viewed.space, model, key[2])), selector

    def mesh(self, cut_m: float | None) -> bytes | None:
        """Return the mesh below a height as GLB, None without a mesh; thread-safe."""
        mesh = self.viewed.mesh
        if mesh is None:
            return None
        key = None if cut_m is None else round(cut_m / STEP_M) * STEP_M
        with self._lock:
            return _cached(self._meshes, key, MAX_MESHES, lambda: mesh_glb(mesh, key))

    def landmark_scorer(self, occlusion: str) -> Scorer | None:
        """Return the scorer of the best weights, which gives landmark probabilities for methods that have none."""
        try:
            return self.viewed.selector("", occlusion).scorer
        except WhereToLookError:
            return None


def _cached(cache: OrderedDict[K, V], key: K, max_size: int, make: Callable[[], V]) -> V:
    """Return the value of a key, made if missing; the least recently used values are dropped."""
    if key not in cache:
        cache[key] = make()
        if len(cache) > max_size:
            cache.popitem(last=False)
    cache.move_to_end(key)
    return cache[key]
