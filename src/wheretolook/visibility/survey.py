"""Count what every location sees in every direction, from a map and an occlusion model, in bounded memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.memory import fitting
from wheretolook.visibility.counting import FrustumCounter
from wheretolook.visibility.counting_kernel import pack_kernel
from wheretolook.visibility.occlusion import DevicePoints, OcclusionModel, StoredOcclusion

BYTES_TO_RANK = 4  # of every direction at every location, for those who ask which rank it has
CPU_BLOCK_BYTES = 1 << 24  # on a CPU a block of locations should fit into the cache


@dataclass(frozen=True, eq=False)
class Survey:
    """What L locations see in D directions."""

    counts: NDArray[np.int32]  # (L, D) landmarks in view (or distinct pixels, if so asked)
    best: NDArray[np.int32]  # (L, K) the K directions that see most: by falling count, then by rising direction
    # which landmarks each location has a free line of sight to; None if it was not to be kept.
    occlusion: StoredOcclusion | None


def survey(
    camera: Camera,
    rotations: ArrayLike,
    locations: ArrayLike,
    points: ArrayLike | DevicePoints,
    occlusion: OcclusionModel,
    *,
    keep: int = 0,
    distinct_pixels: bool = False,
    keep_occlusion: bool = True,
    device: str = "cpu",
    threads: int = 0,
    memory_bytes: int = 2 << 30,
    progress: str | None = None,
) -> Survey:
    """Find the landmarks (N, 3) m that are unoccluded from each of locations (L, 3) m, and count those in view.

    They are counted (paper, Sec. 3.2) for each of rotations (D, 3, 3) cam_from_world, or with `distinct_pixels` the
    pixels that see one; of the directions the best `keep` are returned for each location, 0 for all. Works through the
    locations in blocks, which take at most `memory_bytes` on the device at a time, so that memory does not grow with
    their number (except for the result: a bit for each location and landmark, if occlusion is kept). On a CPU with as
    many threads as said, 0 for all cores. The progress bar has a text; None shows none.

    Raises a MapError if there are no landmarks; a SceneError if there are no locations, or `OcclusionModel.check`
    refuses one; a ConfigError if a single location takes more memory than allowed, or the counts more than there is.
    """
    at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
    if len(at) == 0:
        raise SceneError("there are no locations to look from", value=0, fix="Refine the grid or check the bounds.")
    if keep < 0 or threads < 0:
        raise ConfigError("keep and threads must not be negative", value=(keep, threads))
    positions = points.positions if isinstance(points, DevicePoints) else np.asarray(points, np.float64).reshape(-1, 3)
    occlusion.check(at, positions)
    landmarks = points if isinstance(points, DevicePoints) else DevicePoints(positions, device)
    n_points = len(landmarks)
    on_gpu = wp.get_device(landmarks.device).is_cuda
    workers = 1 if on_gpu or occlusion.uses_all_cores else (threads or len(os.sched_getaffinity(0)))
    scratch = max(1, memory_bytes // (4 * workers))
    orientations = np.asarray(rotations)
    counter = FrustumCounter(camera, orientations, n_points, landmarks.device, distinct_pixels, scratch_bytes=scratch)
    n_directions = len(counter.rotations)
    keep = min(keep or n_directions, n_directions)
    if len(at) * n_directions > (most := fitting(4 + 4 + BYTES_TO_RANK)):
        problem = f"{n_directions:,} directions at {len(at):,} locations are more than there is memory for"
        fix = f"{most // len(at):,} directions would fit, or fewer locations."
        raise ConfigError(problem, value=len(at) * n_directions, fix=fix)
    per_location = counter.bytes_per_location(n_points) + n_points  # and its mask
    least = per_location + counter.fixed_bytes
    if least > memory_bytes:
        problem = f"one location with {n_points:,} landmarks takes {least:,} bytes"
        raise ConfigError(problem, value=memory_bytes, fix=f"Allow at least {least} bytes.")
    workers = min(workers, memory_bytes // least)
    share = memory_bytes // workers - counter.fixed_bytes
    if not on_gpu and not occlusion.uses_all_cores:
        share = min(share, CPU_BLOCK_BYTES)
    block = min(max(1, share // per_location), counter.max_locations(n_points), -(-len(at) // workers))
    if occlusion.uses_all_cores:
        block = min(block, 16 * len(os.sched_getaffinity(0)))  # enough for all cores, and the progress bar moves

    counts = np.empty((len(at), n_directions), dtype=np.int32)
    best = np.empty((len(at), keep), dtype=np.int32)
    all_free = np.packbits(np.ones(n_points, dtype=bool))
    packed = np.empty((len(at) if keep_occlusion else 0, len(all_free)), dtype=np.uint8)

    def work(rows: slice) -> int:
        mask = occlusion.unoccluded_on_device(at[rows], landmarks)
        counted = counter.count(at[rows], landmarks.double, mask)
        best[rows] = _best(counted, keep, on_gpu)
        counts[rows] = counted.numpy()
        if keep_occlusion:
            packed[rows] = all_free if mask is None else _pack(mask, landmarks)
        return rows.stop - rows.start

    blocks = [slice(start, min(start + block, len(at))) for start in range(0, len(at), block)]
    with tqdm(total=len(at), desc=progress, unit="location", disable=progress is None) as bar:
        for done in _each(work, blocks, workers):
            bar.update(done)
    return Survey(counts, best, StoredOcclusion(at, packed, n_points, occlusion.name) if keep_occlusion else None)


def _each(work: Callable[[slice], int], blocks: list[slice], workers: int) -> Iterator[int]:
    """Results of all blocks. Warp releases Python's lock while a kernel runs, so that threads use several cores."""
    if workers == 1:
        yield from map(work, blocks)
        return
    with ThreadPoolExecutor(workers) as pool:
        try:
            yield from pool.map(work, blocks)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _best(counts: Any, keep: int, on_gpu: bool) -> NDArray[np.int32]:
    """The directions (L, K) with the highest of the counts (L, D), ties by direction."""
    if not on_gpu:
        return np.argsort(-counts.numpy(), axis=1, kind="stable")[:, :keep].astype(np.int32)
    import torch

    wp.synchronize_device(counts.device)  # Torch works on a stream of its own
    order = torch.sort(wp.to_torch(counts), dim=1, descending=True, stable=True).indices
    return np.asarray(order[:, :keep].to(torch.int32).cpu().numpy())


def _pack(mask: Any, landmarks: DevicePoints) -> NDArray[np.uint8]:
    """A mask (L, N) in the device's order as bits (L, ceil(N / 8)) in the map's order, as `numpy.packbits` has them."""
    packed: Any = wp.empty((mask.shape[0], (mask.shape[1] + 7) // 8), dtype=wp.uint8, device=mask.device)
    wp.launch(pack_kernel, packed.shape, [mask, landmarks.rank], [packed], device=mask.device)
    return np.asarray(packed.numpy())
