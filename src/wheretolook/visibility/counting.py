"""Count and list the visible landmarks of all directions at a location, by cells of the sphere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import Float, as_points
from wheretolook.utils.devices import fitting, in_threads
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.processes import cores
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import counting_kernel, frustum_kernel
from wheretolook.visibility.frustum import (
    MIN_DEPTH_M,
    camera_sees,
    cell_centers,
    decided,
    frustum_sides,
    near_radius_m,
    octahedral_directions,
    sides_rounding,
    tabulate,
)
from wheretolook.visibility.occlusion import DevicePoints, OcclusionModel, StoredOcclusion

ROUNDING = 1e-5  # least relative distance of a cell's corners from a plane, since rounding may move landmarks into it


def choose_size(n_points: int, n_rotations: int = 1) -> int:
    """Cells along a side of the map, an even number. About six landmarks a cell were fastest on CPU and GPU.

    At least 32: of larger cells most are on the border of a view, whose landmarks are tested one by one. Fewer where the
    cells of very many orientations would take too much memory.
    """
    # 2^28 cells of all orientations together: a byte each while they are classified
    most = min(256, 2 * int(np.sqrt((1 << 28) / max(n_rotations, 1)) / 2))
    return int(min(max(32, 2 * round(np.sqrt(n_points / 6) / 2)), max(8, most)))


@dataclass(frozen=True, eq=False)
class CellRuns:
    """Runs of neighbouring cells for each of D orientations, on a device."""

    starts: Any  # (D * size + 1,) int32; orientation d has the runs from `starts[d * size]` to `starts[(d + 1) * size]`
    cells: Any  # (n,) pairs of int32: the first cell of a run, and the one after its last


def cells_in_view(camera: Camera, rotations: Float, size: int, device: str) -> tuple[CellRuns, CellRuns]:
    """Classify the cells, `size` along a side of the map, for rotations (D, 3, 3) cam_from_world, on a Warp device.

    Returns the runs of cells wholly in view, and of those that are partly in view, or may be.
    """
    shape = (len(rotations), size * size)
    classes: Any = wp.empty(shape, dtype=wp.uint8, device=device)

    def upload(values: Float, dtype: Any) -> Any:
        return wp.array(np.asarray(values, dtype=np.float32), dtype=dtype, device=device)

    if isinstance(camera, ColmapCamera):
        field = tabulate(camera)
        centers, radii = cell_centers(size)
        arrays = [upload(rotations, wp.mat33), upload(centers, wp.vec3), upload(field.depth_rad, wp.float32)]
        inputs = [*arrays, field.size, float(radii.max()) + ROUNDING]
        wp.launch(counting_kernel.classify_field_kernel, shape, inputs, [classes], device=device)
    else:
        edge = np.arange(size + 1) / size * 2 - 1
        corners = octahedral_directions(edge[None, :], edge[:, None]).reshape(-1, 3)
        sides = frustum_sides(camera, rotations)
        margin = float(ROUNDING * np.linalg.norm(sides, axis=-1).max(initial=0))
        inputs = [upload(sides, wp.vec3), upload(corners, wp.vec3), size, margin]
        wp.launch(counting_kernel.classify_pinhole_kernel, shape, inputs, [classes], device=device)
    return _runs(classes, size)


def _runs(classes: Any, size: int) -> tuple[CellRuns, CellRuns]:
    """Runs of cells of the classes INSIDE and BORDER, from the classes (D, size * size) of all cells."""
    device = classes.device
    shape = (2, classes.shape[0], size)
    n_rows = classes.shape[0] * size
    numbers: Any = wp.zeros(2 * n_rows + 1, dtype=wp.int32, device=device)
    none: list[Any] = [wp.empty(0, dtype=dtype, device=device) for dtype in (wp.int32, wp.vec2i)]
    inputs = [classes, classes.shape[0], size]
    wp.launch(counting_kernel.runs_kernel, shape, [*inputs, False, none[0]], [numbers, none[1]], device=device)
    starts: Any = wp.empty_like(numbers)
    wp.utils.array_scan(numbers, starts, inclusive=False)
    cells: Any = wp.empty(int(starts[2 * n_rows :].numpy()[0]), dtype=wp.vec2i, device=device)
    wp.launch(counting_kernel.runs_kernel, shape, [*inputs, True, starts], [numbers, cells], device=device)
    return CellRuns(starts[: n_rows + 1], cells), CellRuns(starts[n_rows:], cells)


class FrustumCounter:
    """Counts the landmarks in view from any location, for a fixed set of orientations.

    The landmarks around a location are sorted into cells of the sphere of directions (`cells_in_view`). A cell wholly in
    view counts with all its landmarks; landmarks are tested one by one only in cells on the border of the view.

    `rotations` (D, 3, 3) are cam_from_world; `device` is "cpu" or a CUDA device. `n_points`, about how many landmarks
    will be counted, sets the number of cells, unless `size` gives the even number of cells along a side of the sphere's map.
    `scratch_bytes` is the memory for lists of landmarks that a COLMAP camera itself must project. Raises ConfigError if
    there is no such device.
    """

    def __init__(
        self,
        camera: Camera,
        rotations: Float,
        n_points: int,
        device: str = "cpu",
        size: int | None = None,
        scratch_bytes: int = 1 << 28,
    ) -> None:
        self.camera = camera
        self.scratch_bytes = scratch_bytes
        self.rotations = np.asarray(rotations, dtype=np.float32)
        self.device = start_warp(device)
        wp.load_module(counting_kernel, device=self.device)  # only one thread may do that
        # threads that share a location and an orientation
        self.lanes = 16 if wp.get_device(self.device).is_cuda else 1
        self._field = tabulate(camera) if isinstance(camera, ColmapCamera) else None
        self.size = size or choose_size(n_points, len(self.rotations))
        self.inside, self.border = cells_in_view(camera, rotations, self.size, self.device)
        self._axes: Any = wp.array(self.rotations, dtype=wp.mat33, device=self.device)
        self._near = 0.0
        if isinstance(camera, PinholeCamera):
            sides = frustum_sides(camera, rotations)
            self._sides: Any = wp.array(sides, dtype=wp.vec3, device=self.device)
            self._rounding = sides_rounding(sides)
            self._near = near_radius_m(camera)
        elif self._field is not None:
            self._depth: Any = wp.array(self._field.depth_rad, dtype=wp.float32, device=self.device)

    def bytes_per_location(self, n_points: int) -> int:
        """Memory in bytes that `count` and the ranking of its result take for each location."""
        return n_points * (8 + 12) + (self.size**2 + 1) * 8 + len(self.rotations) * (4 + 4 + 8 + 8)

    @property
    def fixed_bytes(self) -> int:
        """Memory in bytes that `count` takes for any number of locations."""
        return self.scratch_bytes if isinstance(self.camera, ColmapCamera) else 0

    def max_locations(self, n_points: int) -> int:
        """The most locations that `count` takes at a time: entries are numbered by int32."""
        return int(np.iinfo(np.int32).max // max(n_points, self.size**2 + 1)) - 1

    def count(self, locations: ArrayLike, points: Any, unoccluded: Any | None = None) -> Any:
        """Counts (L, D), int32, from camera centres (L, 3) in the world, metres.

        Counts, landmarks (N,) of vec3d and mask (L, N) of bool are Warp arrays on the device; without a mask all lines
        of sight are free. Raises a ConfigError for more than `max_locations`; `survey` divides them into blocks.
        """
        at = as_points(locations)
        if len(at) > (most := self.max_locations(points.shape[0])):
            raise ConfigError("too many locations at once", value=len(at), fix=f"Give at most {most}, or use survey.")
        counts: Any = wp.zeros((len(at), len(self.rotations)), dtype=wp.int32, device=self.device)
        landmarks, _ = self._sorted(at, points, unoccluded)
        if self._field is not None:
            return self._count_by_field(landmarks, counts)
        inputs = [self._sides, landmarks, self._rounding, wp.float64(MIN_DEPTH_M), self.lanes]
        wp.launch(counting_kernel.count_kernel, (*counts.shape, self.lanes), inputs, [counts], device=self.device)
        return counts

    def _sorted(self, at: Float, points: Any, unoccluded: Any | None) -> tuple[Any, Any]:
        """Landmarks sorted into cells around locations (L, 3), and their places (L, N), see `cell_kernel`."""
        device = self.device
        n_cells = self.size**2 + 1
        shape = (len(at), points.shape[0])
        centers: Any = wp.array(at, dtype=wp.vec3d, device=device)
        places: Any = wp.empty(shape, dtype=wp.vec2i, device=device)
        numbers: Any = wp.zeros(len(at) * n_cells + 1, dtype=wp.int32, device=device)
        mask = wp.empty((0, 0), dtype=wp.bool, device=device) if unoccluded is None else unoccluded
        inputs = [centers, points, unoccluded is not None, mask, self.size, self._near]
        wp.launch(counting_kernel.cell_kernel, shape, inputs, [places, numbers], device=device)
        starts: Any = wp.empty_like(numbers)
        wp.utils.array_scan(numbers, starts, inclusive=False)
        offsets: Any = wp.empty(max(1, shape[0] * shape[1]), dtype=wp.vec3, device=device)
        inputs = [centers, points, places, starts, self.size]
        wp.launch(counting_kernel.sort_kernel, shape, inputs, [offsets], device=device)
        landmarks: Any = counting_kernel.SortedLandmarks()
        landmarks.size = self.size
        landmarks.starts = starts
        landmarks.offsets = offsets
        landmarks.inside_starts = self.inside.starts
        landmarks.inside = self.inside.cells
        landmarks.border_starts = self.border.starts
        landmarks.border = self.border.cells
        return landmarks, places

    def _count_by_field(self, landmarks: Any, counts: Any) -> Any:
        assert self._field is not None
        device = self.device
        shared = [self._axes, self._depth, self._field.size, landmarks]
        views = counts.flatten()
        n_views = counts.shape[0] * counts.shape[1]
        capacity = max(1, self.scratch_bytes // 20)  # bytes of an entry of both lists
        first = 0
        block = n_views
        number: Any = wp.empty(1, dtype=wp.int32, device=device)
        pairs, unsure = self._unsure_lists(capacity)
        while first < n_views:
            block = min(block, n_views - first)
            number.zero_()
            inputs = [*shared, first, self.lanes]
            outputs = [counts, number, pairs, unsure]
            wp.launch(counting_kernel.count_field_kernel, (block, self.lanes), inputs, outputs, device=device)
            n = int(number.numpy()[0])
            if n <= capacity:
                self._ask_camera(pairs[:n].numpy(), unsure[:n].numpy(), counts)
                first += block
                continue
            # The list was too short: again with fewer views, or with a longer list if there is one view only.
            views[first : first + block].zero_()
            if block == 1:
                capacity = n
                pairs, unsure = self._unsure_lists(n)
            block = max(1, block * capacity // (2 * n))
        return counts

    def _unsure_lists(self, capacity: int) -> tuple[Any, Any]:
        """Room for the pairs of location and orientation, and the offsets, of landmarks that the table leaves open."""
        pairs, unsure = (wp.empty(capacity, dtype=dtype, device=self.device) for dtype in (wp.vec2i, wp.vec3))
        return pairs, unsure

    def _ask_camera(self, pairs: NDArray[np.int32], offsets: NDArray[np.float32], counts: Any) -> None:
        """Add the offsets (n, 3) that the camera sees to the counts of their pairs (n, 2), location and orientation."""
        assert isinstance(self.camera, ColmapCamera)
        more = np.zeros(counts.shape, dtype=np.int32)
        location, orientation = pairs.T
        seen = camera_sees(self.camera, self.rotations, orientation, offsets)
        np.add.at(more, (location[seen], orientation[seen]), 1)
        wp.copy(counts, wp.array(counts.numpy() + more, dtype=wp.int32, device=self.device))


@dataclass(frozen=True, eq=False)
class ListedViews:
    """Landmarks in view of V views."""

    n_visible: NDArray[
        np.float32
    ]  # (V,) in view; estimated where only a camera of COLMAP can decide, and a part is listed
    starts: NDArray[np.int64]  # (V,) first entry of each view in the next two
    lengths: NDArray[np.int64]  # (V,) listed landmarks
    entries: Any  # int32 entries of the sorted landmarks, on the lister's device
    image: Any  # vec2, x / z and y / z in the camera, likewise


def compile_kernels(device: str) -> None:
    """Compile the kernels that scoring candidate views launches, or load them from Warp's cache.

    Compiling takes seconds of one core, once on a machine; other threads can work meanwhile. One of them only may load
    kernels at a time, so this has to end before a `FrustumLister` is made. The device is Warp's, of `start_warp`.
    """
    for module in (counting_kernel, frustum_kernel):
        wp.load_module(module, device=device)


class FrustumLister(FrustumCounter):
    """Lists what `FrustumCounter` counts, by the same cells and the same exact tests.

    Views (V, 2) are given by rows of the locations and of the rotations.
    """

    def surroundings(self, locations: ArrayLike, points: Any, unoccluded: Any | None) -> Any:
        """`counting_kernel.SortedLandmarks`: the M that are unoccluded from locations (L, 3) m.

        Landmarks (N,) of vec3d and mask (L, N) of bool are Warp arrays on the device; without a mask all lines of sight
        are free.
        """
        at = as_points(locations)
        n_cells = self.size**2 + 1
        landmarks, places = self._sorted(at, points, unoccluded)
        number = int(landmarks.starts[len(at) * n_cells :].numpy()[0])
        landmarks.rows = wp.empty(number, dtype=wp.int32, device=self.device)
        inputs = [places, landmarks.starts, n_cells]
        wp.launch(counting_kernel.rows_kernel, places.shape, inputs, [landmarks.rows], device=self.device)
        return landmarks

    def list(self, candidates: Any, views: NDArray[np.integer[Any]], limit: int) -> ListedViews:
        """What views see of `surroundings`.

        Of more than `limit` landmarks every second of the map's, every fourth, and so on, are listed, so that between
        half of `limit` and `limit` remain; never more than twice as many.
        """
        strides = np.ones(len(views), dtype=np.int64)
        in_view, *_ = self._launch(candidates, views, strides, 0 * strides)
        strides <<= np.ceil(np.log2(np.maximum(in_view, 1) / limit)).clip(0).astype(np.int64)
        rooms = np.minimum(in_view, 2 * limit)
        lengths, entries, image = self._launch(candidates, views, strides, rooms)
        lengths = np.minimum(lengths, rooms)
        starts = np.cumsum(rooms) - rooms
        camera = self.camera
        if not isinstance(camera, ColmapCamera):
            return ListedViews(in_view.astype(np.float32), starts, lengths, entries, image)
        used = np.repeat(starts + lengths, rooms) > np.arange(rooms.sum())
        on_host = entries.numpy()[used]

        def sees(view: NDArray[np.int64], rows: NDArray[np.int32]) -> NDArray[np.bool_]:
            return camera_sees(camera, self.rotations, views[view, 1], candidates.offsets.numpy()[rows])

        kept, ends = decided(on_host, np.concatenate([[0], np.cumsum(lengths)]), sees)
        share = np.diff(ends) / np.maximum(lengths, 1)
        there: Any = wp.array(on_host[kept], dtype=wp.int32, device=self.device)
        seen: Any = wp.array(image.numpy()[used][kept], dtype=wp.vec2, device=self.device)
        return ListedViews((share * in_view).astype(np.float32), ends[:-1], np.diff(ends), there, seen)

    def _launch(
        self, candidates: Any, views: Any, strides: NDArray[np.int64], rooms: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], Any, Any]:
        """Return the landmarks that views see, (V,) and, in the room that each has, their entries and positions."""
        ends = np.concatenate([[0], np.cumsum(rooms)])
        asked: Any = wp.array(np.column_stack([views, strides]).astype(np.int32), dtype=wp.vec3i, device=self.device)
        rotations = [asked, self._axes]
        shared = [candidates, wp.array(ends, dtype=wp.int64, device=self.device)]
        shapes = ((len(views), wp.int64), (int(ends[-1]), wp.int32), (int(ends[-1]), wp.vec2))
        outputs: list[Any] = [wp.empty(size, dtype=dtype, device=self.device) for size, dtype in shapes]
        if self._field is not None:
            kernel, inputs = counting_kernel.list_field_kernel, [self._depth, self._field.size, *shared]
        else:
            least = wp.float64(MIN_DEPTH_M)
            kernel, inputs = counting_kernel.list_kernel, [self._sides, self._rounding, least, *shared]
        wp.launch(kernel, len(views), [*rotations, *inputs], outputs, device=self.device)
        return np.asarray(outputs[0].numpy()), outputs[1], outputs[2]


@dataclass(frozen=True, eq=False)
class Survey:
    """What L locations see in D directions."""

    counts: NDArray[np.int32]  # (L, D) landmarks in view
    best: NDArray[np.int32]  # (L, K) the K directions that see most: by falling count, then by rising direction
    occlusion: StoredOcclusion | None  # landmarks with a free line of sight from each location, if kept


@dataclass(frozen=True)
class SurveyOptions:
    """How a survey is computed."""

    keep: int = 0  # directions returned in `Survey.best` for each location; 0 for all
    keep_occlusion: bool = True  # return the mask of unoccluded landmarks
    device: str = "cpu"
    threads: int = 0  # on a CPU; 0 for all cores
    memory_bytes: int = 2 << 30  # bound on the memory that counting takes on the device
    progress: str | None = None  # text of the progress bar; None shows none


def survey(
    camera: Camera,
    rotations: ArrayLike,
    locations: ArrayLike,
    points: ArrayLike | DevicePoints,
    occlusion: OcclusionModel,
    options: SurveyOptions = SurveyOptions(),
) -> Survey:
    """Count the unoccluded landmarks (N, 3) m in view from locations (L, 3) m (paper, Sec. 3.2).

    They are counted for each of rotations (D, 3, 3) cam_from_world, and the best directions of each location are
    returned. Locations are processed in blocks that fit into `options.memory_bytes`; only the result grows with their
    number, by a bit for each location and landmark if occlusion is kept.

    Raises:
        MapError: there are no landmarks.
        SceneError: there are no locations, or `OcclusionModel.check` refuses one.
        ConfigError: a single location takes more memory than allowed, or the counts more than there is.
    """
    at = as_points(locations)
    if len(at) == 0:
        raise SceneError("there are no locations to look from", value=0, fix="Refine the grid or check the bounds.")
    positions = points.positions if isinstance(points, DevicePoints) else as_points(points)
    occlusion.check(at, positions)
    landmarks = points if isinstance(points, DevicePoints) else DevicePoints(positions, options.device)
    n_points = len(landmarks)
    on_gpu = wp.get_device(landmarks.device).is_cuda
    workers = 1 if on_gpu or occlusion.uses_all_cores else (options.threads or cores())
    scratch = max(1, options.memory_bytes // (4 * workers))
    directions = np.asarray(rotations, dtype=np.float64).tobytes()
    counter = _counter(camera, directions, n_points, landmarks.device, scratch)
    n_directions = len(counter.rotations)
    _check_counts(len(at), n_directions)
    workers, block = _workers_and_block(counter, len(at), n_points, workers, options.memory_bytes, occlusion)

    keep = min(options.keep or n_directions, n_directions)
    counts = np.empty((len(at), n_directions), dtype=np.int32)
    best = np.empty((len(at), keep), dtype=np.int32)
    all_free = np.packbits(np.ones(n_points, dtype=bool))
    packed = np.empty((len(at) if options.keep_occlusion else 0, len(all_free)), dtype=np.uint8)

    def work(rows: slice) -> int:
        mask = occlusion.unoccluded_on_device(at[rows], landmarks)
        counted = counter.count(at[rows], landmarks.double, mask)
        results: list[tuple[Any, NDArray[Any]]] = [(counted, counts), (_best(counted, keep), best)]
        if options.keep_occlusion and mask is not None:
            results.append((_pack(mask, landmarks), packed))
        elif options.keep_occlusion:
            packed[rows] = all_free
        for values, result in results:  # all kernels are in the GPU's queue before the first copy waits for them
            wp.copy(wp.array(result[rows], dtype=values.dtype, device="cpu", copy=False), values)
        wp.synchronize_device(landmarks.device)
        return rows.stop - rows.start

    blocks = [slice(start, min(start + block, len(at))) for start in range(0, len(at), block)]
    with tqdm(total=len(at), desc=options.progress, unit="location", disable=options.progress is None) as bar:
        for done in in_threads(work, blocks, workers):
            bar.update(done)
    stored = StoredOcclusion(at, packed, n_points, occlusion.name) if options.keep_occlusion else None
    return Survey(counts, best, stored)


@lru_cache(maxsize=2)
def _counter(camera: Camera, rotations: bytes, n_points: int, device: str, scratch_bytes: int) -> FrustumCounter:
    """The counter for rotations (D, 3, 3) of float64, kept for the next survey of the same directions."""
    axes = np.frombuffer(rotations).reshape(-1, 3, 3)
    return FrustumCounter(camera, axes, n_points, device, scratch_bytes=scratch_bytes)


def _check_counts(n_locations: int, n_directions: int) -> None:
    """Raise ConfigError if the counts of all views do not fit into memory."""
    most = fitting(4 + 4 + 4)  # its count, its place among the best, and its rank for those who ask for it
    if n_locations * n_directions > most:
        problem = f"{n_directions:,} directions at {n_locations:,} locations do not fit into memory"
        raise ConfigError(problem, fix=f"{most // n_locations:,} directions would fit, or fewer locations.")


def _workers_and_block(
    counter: FrustumCounter, n_locations: int, n_points: int, workers: int, memory_bytes: int, occlusion: OcclusionModel
) -> tuple[int, int]:
    """Number of threads, at most `workers`, and of locations in a block, so that the memory suffices."""
    per_location = counter.bytes_per_location(n_points) + n_points  # and its mask
    required = per_location + counter.fixed_bytes
    if required > memory_bytes:
        problem = f"one location with {n_points:,} landmarks takes {required:,} bytes"
        raise ConfigError(problem, value=memory_bytes)
    workers = min(workers, memory_bytes // required)
    share = memory_bytes // workers - counter.fixed_bytes
    if counter.device == "cpu" and not occlusion.uses_all_cores:
        share = min(share, 1 << 24)  # a block of locations should fit into the cache
    block = min(max(1, share // per_location), counter.max_locations(n_points), -(-n_locations // workers))
    if occlusion.uses_all_cores:
        block = min(block, 16 * cores())  # enough for all cores, and the progress bar moves
    return workers, block


def _best(counts: Any, keep: int) -> Any:
    """The directions (L, K) with the highest of the counts (L, D), ties by direction; Warp arrays of int32."""
    if counts.device.is_cpu:
        return wp.array(np.argsort(-counts.numpy(), axis=1, kind="stable")[:, :keep], dtype=wp.int32, device="cpu")
    best: Any = wp.empty((counts.shape[0], keep), dtype=wp.int32, device=counts.device)
    wp.launch(counting_kernel.best_kernel, counts.shape, [counts, counts.shape[1], keep], [best], device=counts.device)
    return best


def _pack(mask: Any, landmarks: DevicePoints) -> Any:
    """A mask (L, N) in the device's order as bits (L, ceil(N / 8)) in the map's order, as `numpy.packbits` has them."""
    packed: Any = wp.empty((mask.shape[0], (mask.shape[1] + 7) // 8), dtype=wp.uint8, device=mask.device)
    wp.launch(counting_kernel.pack_kernel, packed.shape, [mask, landmarks.rank], [packed], device=mask.device)
    return packed
