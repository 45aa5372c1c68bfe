"""Count what every location sees in every direction, from a map and an occlusion model, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera
from wheretolook.utils.devices import fitting, in_threads
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.processes import cores
from wheretolook.visibility.counting import FrustumCounter
from wheretolook.visibility.counting_kernel import best_kernel, pack_kernel
from wheretolook.visibility.occlusion import DevicePoints, OcclusionModel, StoredOcclusion

BYTES_TO_RANK = 4  # of every direction at every location, for those who ask which rank it has
CPU_BLOCK_BYTES = 1 << 24  # on a CPU a block of locations should fit into the cache


@dataclass(frozen=True, eq=False)
class Survey:
    """What L locations see in D directions."""

    counts: NDArray[np.int32]  # (L, D) landmarks in view, or what another counter counts
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
    counter: type[FrustumCounter] = FrustumCounter  # what is counted


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
    at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
    if len(at) == 0:
        raise SceneError("there are no locations to look from", value=0, fix="Refine the grid or check the bounds.")
    positions = points.positions if isinstance(points, DevicePoints) else np.asarray(points, np.float64).reshape(-1, 3)
    occlusion.check(at, positions)
    landmarks = points if isinstance(points, DevicePoints) else DevicePoints(positions, options.device)
    n_points = len(landmarks)
    on_gpu = wp.get_device(landmarks.device).is_cuda
    workers = 1 if on_gpu or occlusion.uses_all_cores else (options.threads or cores())
    scratch = max(1, options.memory_bytes // (4 * workers))
    directions = np.asarray(rotations, dtype=np.float64).tobytes()
    counter = _counter(options.counter, camera, directions, n_points, landmarks.device, scratch)  # type: ignore[arg-type]
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
def _counter(
    kind: Any, camera: Camera, rotations: bytes, n_points: int, device: str, scratch_bytes: int
) -> FrustumCounter:
    """The counter for rotations (D, 3, 3) of float64, kept for the next survey of the same directions."""
    axes = np.frombuffer(rotations).reshape(-1, 3, 3)
    counter: FrustumCounter = kind(camera, axes, n_points, device, scratch_bytes=scratch_bytes)
    return counter


def _check_counts(n_locations: int, n_directions: int) -> None:
    """Raise ConfigError if the counts of all views do not fit into memory."""
    most = fitting(4 + 4 + BYTES_TO_RANK)
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
        share = min(share, CPU_BLOCK_BYTES)
    block = min(max(1, share // per_location), counter.max_locations(n_points), -(-n_locations // workers))
    if occlusion.uses_all_cores:
        block = min(block, 16 * cores())  # enough for all cores, and the progress bar moves
    return workers, block


def _best(counts: Any, keep: int) -> Any:
    """The directions (L, K) with the highest of the counts (L, D), ties by direction; Warp arrays of int32."""
    if counts.device.is_cpu:
        return wp.array(np.argsort(-counts.numpy(), axis=1, kind="stable")[:, :keep], dtype=wp.int32, device="cpu")
    best: Any = wp.empty((counts.shape[0], keep), dtype=wp.int32, device=counts.device)
    wp.launch(best_kernel, counts.shape, [counts, counts.shape[1], keep], [best], device=counts.device)
    return best


def _pack(mask: Any, landmarks: DevicePoints) -> Any:
    """A mask (L, N) in the device's order as bits (L, ceil(N / 8)) in the map's order, as `numpy.packbits` has them."""
    packed: Any = wp.empty((mask.shape[0], (mask.shape[1] + 7) // 8), dtype=wp.uint8, device=mask.device)
    wp.launch(pack_kernel, packed.shape, [mask, landmarks.rank], [packed], device=mask.device)
    return packed
