"""SIFT in Warp, for CUDA: OpenCV's keypoints and descriptors up to rounding, with bit-identical repetitions."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.features import warp_sift_description_kernels as kernels
from wheretolook.features.keypoints import ExtractorConfig, Keypoints
from wheretolook.features.warp_sift_kernels import BORDER, KEYS_OF_IMAGE, MAX_SIDE, Limits
from wheretolook.features.warp_sift_scale_space import ScaleSpace, roomy, values_of_image
from wheretolook.utils.warp import start_warp


class WarpSift:
    """Extracts SIFT keypoints of many images at once (Lowe, IJCV 2004).

    The plain twin is `cv2.SIFT` as `KeypointExtractor` uses it, with the same constants and conventions but another
    order of summation. The keypoints of an image do not depend on the others in its batch. An extractor must be used by
    one thread only, since it keeps its memory on the device from call to call.

    Args:
        config: see `ExtractorConfig`; its method is ignored.
        device: a CUDA device, or "cpu" (one core and slow: for tests).
        block_bytes: memory of the scale spaces that are filled at a time (40 MB for an image of 640 x 480).

    Raises:
        ConfigError: there is no such device.
    """

    def __init__(self, config: ExtractorConfig, device: str = "cuda", block_bytes: int = 1 << 30) -> None:
        self.config = config
        self.device = start_warp(device)
        self.block_bytes = block_bytes
        limits: Any = Limits()
        # OpenCV rounds the threshold of the extremum itself down to a whole grey value.
        limits.pre_contrast = math.floor(0.5 * config.peak_threshold * 255)
        limits.contrast, limits.edge = config.peak_threshold, config.edge_threshold
        self._limits = limits
        self._space: ScaleSpace | None = None
        self._buffers: dict[str, Any] = {}

    def extract_many(self, grey: NDArray[np.uint8] | Any) -> list[Keypoints]:
        """At most `max_keypoints` keypoints of each grey image (B, H, W) uint8, those of most contrast first.

        The images are a NumPy array, or a Warp array on any device.

        Raises:
            ValueError: the images have another shape or type, or are too large.
        """
        if grey.dtype not in (np.uint8, wp.uint8) or grey.ndim != 3:
            raise ValueError(f"expected (B, H, W) uint8 images, got {grey.shape} {grey.dtype}")
        n_images, rows, columns = grey.shape
        size = values_of_image(rows, columns)
        if 2 * max(rows, columns) > MAX_SIDE or size >= 1 << 31:
            raise ValueError(f"expected images of at most {MAX_SIDE // 2} pixels a side, got {grey.shape}")
        if n_images == 0 or min(rows, columns) <= BORDER:
            return [Keypoints.none() for _ in range(n_images)]
        # kernels index the values of a block with 31 bits
        block = max(1, min(n_images, self.block_bytes // (4 * size), (1 << 31) // size - 1))
        space = self._space
        if space is None or (space.rows, space.columns) != (rows, columns) or space.n_images < block:
            self._space = None  # frees its memory first
            self._space = space = ScaleSpace(rows, columns, block, self.config.first_octave, self._limits, self.device)
        found: list[Keypoints] = []
        for start in range(0, n_images, space.n_images):
            stop = min(start + space.n_images, n_images)  # a Warp slice may not exceed the array
            found += self._extract_block(space, grey[start:stop])
        return found

    def _extract_block(self, space: ScaleSpace, grey: Any) -> list[Keypoints]:
        n_images = grey.shape[0]
        space.fill(grey)
        keys = _sorted_unique(space.find())
        if len(keys) == 0:
            return [Keypoints.none() for _ in range(n_images)]
        table, place, angle, places = self._turn(space, keys)
        if len(place) == 0:
            return [Keypoints.none() for _ in range(n_images)]
        image = (keys // KEYS_OF_IMAGE)[place]
        order = _by_response(image, table[place], angle)
        ends = np.searchsorted(image, np.arange(n_images + 1))  # `image` is sorted to begin with
        order = order[np.arange(len(order)) - ends[image] < self.config.max_keypoints]
        ends = np.searchsorted(image[order], np.arange(n_images + 1))
        descriptors = self._describe(space, places, place[order], angle[order])
        # OpenCV puts (0, 0) at the centre of the top-left pixel.
        pixels = table[place[order], :2] + np.float32(0.5)
        scales = table[place[order], 2]
        return [Keypoints(pixels[a:b], descriptors[a:b], scales[a:b]) for a, b in pairwise(ends)]

    def _turn(
        self, space: ScaleSpace, keys: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.float32], Any]:
        """Positions of the K keypoints at sorted keys, and their orientations, N in all.

        Returns:
            (K, 4) x, y, scale and response; the keypoint (N,) and the angle (N,) of each orientation; `Places`.
        """
        n = len(keys)
        places = kernels.Places()
        for name, dtype in kernels.PLACE_TYPES.items():
            setattr(places, name, self._buffer(name, n, dtype))
        table = self._buffer("table", n, wp.float32, 4)
        histograms = self._buffer("turn_histograms", n, wp.float32, kernels.TURN_LANES, kernels.TURN_BINS)
        n_turns = self._buffer("n_turns", n, wp.int32)
        angles = self._buffer("angles", n, wp.float32, kernels.MAX_TURNS)
        on_device = self._upload("keys", keys, wp.int64)
        self._launch(kernels.place_kernel, n, [space.pyramid, on_device, self._limits], [places, table])
        self._launch(kernels.turn_histogram_kernel, (n, kernels.TURN_LANES), [space.pyramid, places], [histograms])
        self._launch(kernels.turn_kernel, n, [histograms], [n_turns, angles])
        number = n_turns[:n].numpy()
        place = np.repeat(np.arange(n), number)
        turn = np.arange(len(place)) - np.repeat(np.cumsum(number) - number, number)
        return table[:n].numpy(), place, angles[:n].numpy()[place, turn], places

    def _describe(
        self, space: ScaleSpace, places: Any, place: NDArray[np.intp], angle: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """RootSIFT (N, 128) at rows (N,) of `places`, for orientations (N,) in degrees."""
        n, cells = len(place), kernels.CELLS * kernels.CELLS
        size = cells * kernels.CELL_BINS
        chosen = self._upload("chosen", place.astype(np.int32), wp.int32)
        turned = self._upload("turned", angle, wp.float32)
        histograms = self._buffer("cell_histograms", n, wp.float32, size)
        descriptors = self._buffer("descriptors", n, wp.float32, size)
        self._launch(kernels.describe_kernel, (n, cells), [space.pyramid, places, chosen, turned], [histograms])
        self._launch(kernels.finish_kernel, n, [histograms], [descriptors])
        found: NDArray[np.float32] = descriptors[:n].numpy()
        return found.copy() if self.device == "cpu" else found  # on the CPU, `found` is the buffer's own memory

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        # small thread blocks, so that a few thousand keypoints occupy all of a GPU
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=64)

    def _buffer(self, name: str, n: int, dtype: Any, *row: int) -> Any:
        """An array of at least n rows, kept from call to call."""
        buffer = self._buffers.get(name)
        if buffer is None or buffer.shape[0] < n:
            shape = (roomy(n), *row)
            buffer = self._buffers[name] = wp.empty(shape, dtype=dtype, device=self.device)
        return buffer

    def _upload(self, name: str, values: NDArray[Any], dtype: Any) -> Any:
        buffer = self._buffer(name, len(values), dtype)
        wp.copy(buffer, wp.array(values, dtype=dtype, device="cpu"), count=len(values))
        return buffer


def _sorted_unique(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    keys = np.sort(keys)
    return keys[np.flatnonzero(np.diff(keys, prepend=-1))]


def _by_response(image: NDArray[np.int64], table: NDArray[np.float32], angle: NDArray[np.float32]) -> NDArray[np.intp]:
    """Order by image, -response, y, x, scale, angle. `table` is x, y, scale, response, which is positive."""
    # Positive floats have the same order as their bits.
    key = (image << 32) - np.ascontiguousarray(table[:, 3]).view(np.int32)
    order = np.argsort(key)
    equal = np.diff(key[order]) == 0
    tied = np.flatnonzero(np.append(equal, False) | np.insert(equal, 0, False))
    rows = order[tied]
    x, y, scale, _ = table[rows].T
    order[tied] = rows[np.lexsort((angle[rows], scale, y, x, key[rows]))]
    return order
