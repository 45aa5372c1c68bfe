"""Lists the landmarks in view at every location in every direction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.visibility import counting_kernel, frustum, frustum_kernel, listing_kernel
from wheretolook.visibility.counting import FrustumCounter
from wheretolook.visibility.field_of_view import tabulate
from wheretolook.visibility.frustum import LandmarkSets, PosedViews


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The M landmarks that are unoccluded from a block of locations, sorted into cells, on the lister's device."""

    sorted: Any  # `counting_kernel.SortedLandmarks`
    rows: Any  # (M,) int32 rows of the points

    @property
    def offsets(self) -> Any:
        """(M,) vec3 from the location to the landmark, in the world, metres."""
        return self.sorted.offsets[: max(1, self.rows.shape[0])]


@dataclass(frozen=True, eq=False)
class ListedViews:
    """The landmarks in view of V views, E in all."""

    starts: NDArray[np.int64]  # (V + 1,); view v has `starts[v]` to `starts[v + 1]` of the next two
    entries: Any  # (E,) int32 rows of `Surroundings`, on the lister's device
    image: Any  # (E,) vec2, x / z and y / z in the camera, likewise


def in_view_by_table(posed: PosedViews, points: Any, device: str = "cpu") -> LandmarkSets:
    """What `frustum.landmarks_in_view` gives for a COLMAP camera, by a table of its field of view; on the host.

    The table takes a second to make, and the camera is asked only about landmarks near the border of the view. Points
    are those of `points_on_device`.
    """
    camera = posed.camera
    assert isinstance(camera, ColmapCamera)
    wp.load_module(listing_kernel, device=device)
    field = tabulate(camera)
    rotations, centers = split_poses(posed.cam_from_world)
    single = rotations.astype(np.float32)
    inputs = [
        wp.array(single, dtype=wp.mat33, device=device),
        wp.array(centers, dtype=wp.vec3d, device=device),
        wp.array(np.asarray(posed.location_rows, dtype=np.int32), dtype=wp.int32, device=device),
        points,
        *frustum.sets_on_device(posed.unoccluded, device),
        wp.array(field.depth_rad, dtype=wp.float32, device=device),
        field.size,
    ]
    lengths: Any = wp.empty(len(single), dtype=wp.int64, device=device)
    none: list[Any] = [wp.empty(0, dtype=dtype, device=device) for dtype in (wp.int64, wp.int32)]
    kernel = listing_kernel.collect_field_kernel
    wp.launch(kernel, len(single), [*inputs, False, none[0]], [lengths, none[1]], device=device)
    starts = np.concatenate([[0], np.cumsum(lengths.numpy())])
    found: Any = wp.empty(int(starts[-1]), dtype=wp.int32, device=device)
    first: Any = wp.array(starts[:-1], dtype=wp.int64, device=device)
    wp.launch(kernel, len(single), [*inputs, True, first], [lengths, found], device=device)
    indices = found.numpy()

    def sees(view: NDArray[np.int64], rows: NDArray[np.int32]) -> NDArray[np.bool_]:
        offsets = (posed.points[rows] - centers[view]).astype(np.float32)
        return frustum.camera_sees(camera, single, view, offsets)

    kept, starts = _decided(indices, starts, sees)
    return LandmarkSets(starts.astype(np.int32), indices[kept])


def _decided(
    entries: NDArray[np.int32],
    starts: NDArray[np.int64],
    sees: Callable[[NDArray[np.int64], NDArray[np.int32]], NDArray[np.bool_]],
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Decide the entries (E,) of V views that the table left to the camera; these are -1 - row, and become rows.

    `sees` returns which of such entries are in view, from their views and rows. Returns which entries are, (E,), and
    the starts (V + 1,) of the views among them.
    """
    unsure = np.flatnonzero(entries < 0)
    entries[unsure] = -1 - entries[unsure]
    view = np.searchsorted(starts, unsure, side="right") - 1
    kept = np.ones(len(entries), dtype=bool)
    kept[unsure] = sees(view, entries[unsure])
    n_lost = np.bincount(view[~kept[unsure]], minlength=len(starts) - 1)
    return kept, np.concatenate([[0], np.cumsum(np.diff(starts) - n_lost)])


def compile_kernels(device: str) -> None:
    """Compile the kernels that scoring candidates places launches, or load them from Warp's cache.

    Compiling takes seconds of one core, once on a machine; other threads can work meanwhile. One of them only may load
    kernels at a time, so this has to end before a `FrustumLister` is made. The device is Warp's, of `start_warp`.
    """
    for module in (counting_kernel, listing_kernel, frustum_kernel):
        wp.load_module(module, device=device)


class FrustumLister(FrustumCounter):
    """Lists what `FrustumCounter` counts, by the same cells and the same exact tests.

    Views (V, 2) are given by rows of the locations and of the rotations.
    """

    def __init__(self, camera: Camera, rotations: Float, n_points: int, device: str = "cpu", **options: Any) -> None:
        super().__init__(camera, rotations, n_points, device, **options)
        wp.load_module(listing_kernel, device=self.device)  # only one thread may do that

    def surroundings(self, locations: ArrayLike, points: Any, unoccluded: Any | None) -> Surroundings:
        """What is unoccluded from locations (L, 3) m.

        Landmarks (N,) of vec3d and mask (L, N) of bool are Warp arrays on the device; without a mask all lines of sight
        are free.
        """
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        n_cells = self.size**2 + 1
        landmarks, places = self._sorted(at, points, unoccluded)
        rows: Any = wp.empty(int(landmarks.starts[len(at) * n_cells :].numpy()[0]), dtype=wp.int32, device=self.device)
        inputs = [places, landmarks.starts, n_cells]
        wp.launch(listing_kernel.rows_kernel, places.shape, inputs, [rows], device=self.device)
        return Surroundings(landmarks, rows)

    def lengths(self, candidates: Surroundings, views: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """How many landmarks views see, (V,). Those are included that only a COLMAP camera itself could decide."""
        lengths: Any = wp.empty(len(views), dtype=wp.int64, device=self.device)
        none = [wp.empty(0, dtype=dtype, device=self.device) for dtype in (wp.int64, wp.int32, wp.vec2)]
        self._launch(candidates, views, False, none[0], lengths, none[1], none[2])
        return np.asarray(lengths.numpy())

    def list(
        self, candidates: Surroundings, views: NDArray[np.integer[Any]], lengths: NDArray[np.int64]
    ) -> ListedViews:
        """What views see, by the lengths (V,) that `lengths` gives of them."""
        starts = np.concatenate([[0], np.cumsum(lengths)])
        entries: Any = wp.empty(int(starts[-1]), dtype=wp.int32, device=self.device)
        image: Any = wp.empty(int(starts[-1]), dtype=wp.vec2, device=self.device)
        first: Any = wp.array(starts[:-1], dtype=wp.int64, device=self.device)
        self._launch(
            candidates, views, True, first, wp.empty(len(views), dtype=wp.int64, device=self.device), entries, image
        )
        camera = self.camera
        if not isinstance(camera, ColmapCamera):
            return ListedViews(starts, entries, image)
        on_host = entries.numpy()

        def sees(view: NDArray[np.int64], rows: NDArray[np.int32]) -> NDArray[np.bool_]:
            return frustum.camera_sees(camera, self.rotations, views[view, 1], candidates.offsets.numpy()[rows])

        kept, starts = _decided(on_host, starts, sees)
        there: Any = wp.array(on_host[kept], dtype=wp.int32, device=self.device)
        return ListedViews(starts, there, wp.array(image.numpy()[kept], dtype=wp.vec2, device=self.device))

    def _launch(
        self, candidates: Surroundings, views: Any, write: bool, first: Any, lengths: Any, entries: Any, image: Any
    ) -> None:
        asked: Any = wp.array(np.asarray(views, dtype=np.int32), dtype=wp.vec2i, device=self.device)
        outputs = [lengths, entries, image]
        if self._field is not None:
            inputs = [asked, self._axes, self._depth, self._field.size, candidates.sorted, write, first]
            wp.launch(listing_kernel.list_field_kernel, len(views), inputs, outputs, device=self.device)
            return
        least = wp.float64(frustum.MIN_DEPTH_M)
        inputs = [asked, self._axes, self._sides, candidates.sorted, self._rounding, least, write, first]
        wp.launch(listing_kernel.list_kernel, len(views), inputs, outputs, device=self.device)
