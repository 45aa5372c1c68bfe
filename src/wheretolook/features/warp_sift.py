"""SIFT in Warp, for CUDA: OpenCV's keypoints and descriptors up to rounding, with bit-identical repetitions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.features import warp_sift_kernels as kernels
from wheretolook.features.extractor import ExtractorConfig, Keypoints, check_image
from wheretolook.features.warp_sift_kernels import BORDER, LAYERS, LEVELS, MAX_SIDE
from wheretolook.utils.warp import Staging, start_warp


class WarpSift:
    """Extracts SIFT keypoints of many images at once (Lowe, IJCV 2004).

    The plain twin is `cv2.SIFT` with the same constants and conventions, but another order of summation. The keypoints
    of an image do not depend on the others in its batch. An extractor must be used by one thread only, since it keeps
    its memory on the device from call to call. It ignores the method of its config, and fills `block_bytes` of scale
    spaces at a time (40 MB for an image of 640 x 480). The device is a CUDA device, or
    "cpu" (one core and slow: for tests). Raises ConfigError if it is missing.
    """

    def __init__(self, config: ExtractorConfig, device: str = "cuda", block_bytes: int = 1 << 30) -> None:
        self.config = config
        self.device = start_warp(device)
        self.block_bytes = block_bytes
        limits: Any = kernels.Limits()
        # OpenCV rounds the threshold of the extremum itself down to a whole grey value.
        limits.pre_contrast = math.floor(0.5 * config.peak_threshold * 255)
        limits.contrast = config.peak_threshold
        limits.edge = config.edge_threshold
        self._limits = limits
        self._space: ScaleSpace | None = None
        self._buffers: dict[str, Any] = {}
        self._staging = Staging()

    def extract_many(self, images: NDArray[np.uint8] | Tensor) -> list[Keypoints]:
        """At most `max_keypoints` keypoints of each grey image (B, H, W) uint8, those of most contrast first.

        Raises ValueError if the images are too large.
        """
        grey = torch.as_tensor(images)
        n_images, rows, columns = grey.shape
        size = values_of_image(rows, columns)
        if 2 * max(rows, columns) > MAX_SIDE or size >= 1 << 31:
            raise ValueError(f"expected images of at most {MAX_SIDE // 2} pixels a side, got {tuple(grey.shape)}")
        if n_images == 0 or min(rows, columns) <= BORDER:
            return [Keypoints.none() for _ in range(n_images)]
        # kernels index the values of a block with 31 bits
        block = max(1, min(n_images, self.block_bytes // (4 * size), (1 << 31) // size - 1))
        space = self._space
        if space is None or (space.rows, space.columns) != (rows, columns) or space.n_images < block:
            self._space = None  # frees its memory first
            self._space = space = ScaleSpace(rows, columns, block, self.config.first_octave, self._limits, self.device)
        keypoints: list[Keypoints] = []
        for start in range(0, n_images, space.n_images):
            keypoints += self._extract_block(space, grey[start : start + space.n_images])
        return keypoints

    def _extract_block(self, space: ScaleSpace, grey: Tensor) -> list[Keypoints]:
        n_images = grey.shape[0]
        space.fill(grey)
        keys = space.find()
        if len(keys) == 0:
            return [Keypoints.none() for _ in range(n_images)]
        table, place, angle, places = self._orientations(space, keys)
        if len(place) == 0:
            return [Keypoints.none() for _ in range(n_images)]
        keys_of_image = (1 << 14) ** 2 * 16 * 4  # `MAX_SIDE` squared, `MAX_OCTAVES` and `MAX_LAYERS`
        image = (keys // keys_of_image)[place]
        order = _by_response(image, table[place], angle, self.device)
        ends = np.searchsorted(image, np.arange(n_images + 1))  # `image` is sorted to begin with
        order = order[np.arange(len(order)) - ends[image] < self.config.max_keypoints]
        ends = np.searchsorted(image[order], np.arange(n_images + 1))
        descriptors = self._describe(space, places, place[order], angle[order])
        # OpenCV puts (0, 0) at the centre of the top-left pixel.
        pixels = table[place[order], :2] + np.float32(0.5)
        return [Keypoints(pixels[a:b], descriptors[a:b]) for a, b in pairwise(ends)]

    def _orientations(
        self, space: ScaleSpace, keys: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.float32], Any]:
        """The K keypoints at sorted keys, and their orientations, N in all.

        (K, 4) x, y, scale and response; the keypoint (N,) and the angle (N,) of each orientation; `Places`.
        """
        n = len(keys)
        places = kernels.Places()
        types = {"level": wp.int32, "octave": wp.int32, "at": wp.vec2i, "centre": wp.vec2, "sigma": wp.float32}
        for name, dtype in types.items():
            setattr(places, name, self._buffer(name, n, dtype))
        table = self._buffer("table", n, wp.float32, 4)
        histograms = self._buffer(
            "orientation_histograms", n, wp.float32, kernels.HISTOGRAM_LANES, kernels.ORIENTATION_BINS
        )
        n_orientations = self._buffer("n_orientations", n, wp.int32)
        angles = self._buffer("angles", n, wp.float32, kernels.ORIENTATION_BINS // 2)  # at most every other is a peak
        on_device = self._upload("keys", keys, wp.int64)
        self._launch(kernels.place_kernel, n, [space.pyramid, on_device, self._limits], [places, table])
        self._launch(
            kernels.orientation_histogram_kernel, (n, kernels.HISTOGRAM_LANES), [space.pyramid, places], [histograms]
        )
        self._launch(kernels.orientation_kernel, n, [histograms], [n_orientations, angles])
        number = n_orientations[:n].numpy()
        place = np.repeat(np.arange(n), number)
        turn = np.arange(len(place)) - np.repeat(np.cumsum(number) - number, number)
        return table[:n].numpy(), place, angles[:n].numpy()[place, turn], places

    def _describe(
        self, space: ScaleSpace, places: Any, place: NDArray[np.intp], angle: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """RootSIFT (N, 128) at rows (N,) of `places`, for orientations (N,) in degrees."""
        n = len(place)
        cells = kernels.CELLS * kernels.CELLS
        size = cells * kernels.CELL_BINS
        chosen = self._upload("chosen", place.astype(np.int32), wp.int32)
        turned = self._upload("turned", angle, wp.float32)
        histograms = self._buffer("cell_histograms", n, wp.float32, size)
        descriptors = self._buffer("descriptors", n, wp.float32, size)
        self._launch(kernels.describe_kernel, (n, cells), [space.pyramid, places, chosen, turned], [histograms])
        self._launch(kernels.finish_kernel, n, [histograms], [descriptors])
        return self._staging.download(descriptors[:n]).copy()

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        # small thread blocks, so that a few thousand keypoints occupy all of a GPU
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=64)

    def _buffer(self, name: str, n: int, dtype: Any, *row: int) -> Any:
        """An array of at least n rows, kept from call to call."""
        buffer = self._buffers.get(name)
        if buffer is None or buffer.shape[0] < n:
            buffer = self._buffers[name] = wp.empty((roomy(n), *row), dtype=dtype, device=self.device)
        return buffer

    def _upload(self, name: str, values: NDArray[Any], dtype: Any) -> Any:
        buffer = self._buffer(name, len(values), dtype)
        wp.copy(buffer, wp.array(values, dtype=dtype, device="cpu"), count=len(values))
        return buffer


def grey_images(images: Sequence[NDArray[np.uint8]] | Sequence[Tensor], device: str) -> Tensor:
    """Convert images (H, W, 3) uint8 of one size to grey (B, H, W) uint8 on a device, exactly as `sift.grey_bitmap`."""
    parts = []
    for image in images:
        if not isinstance(image, Tensor):
            check_image(image)
        parts.append(torch.as_tensor(image))
    rgb = torch.stack(parts)
    red, green, blue = rgb.to(device).unbind(-1)
    grey = (red * 0.2126 + green * 0.7152 + blue * 0.0722 + 0.5).byte()
    if grey.is_cuda:
        torch.cuda.current_stream(grey.device).synchronize()  # Warp reads it in another stream
    return grey


def _by_response(
    image: NDArray[np.int64], table: NDArray[np.float32], angle: NDArray[np.float32], device: str
) -> NDArray[np.intp]:
    """Order by image, -response, y, x, scale, angle. `table` is x, y, scale, response, which is positive."""
    # Positive floats have the same order as their bits.
    key = (image << 32) - np.ascontiguousarray(table[:, 3]).view(np.int32)
    order = torch.from_numpy(key).to(device).argsort().cpu().numpy()
    equal = np.diff(key[order]) == 0
    tied = np.flatnonzero(np.append(equal, False) | np.insert(equal, 0, False))
    rows = order[tied]
    x, y, scale, _ = table[rows].T
    order[tied] = rows[np.lexsort((angle[rows], scale, y, x, key[rows]))]
    return order


class ScaleSpace:
    """The Gaussian scale spaces of up to `n_images` images of one size, and the list of their extrema.

    The smaller of rows and columns must exceed `BORDER`, so that there is an octave. With `first_octave` -1, keypoints
    are detected in the doubled image too, with 0 only from the image's own size on. `limits` is passed to kernels.
    """

    def __init__(self, rows: int, columns: int, n_images: int, first_octave: int, limits: Any, device: str) -> None:
        self.rows = rows
        self.columns = columns
        self.n_images = n_images
        self.device = device
        self.first_octave = first_octave
        self.limits = limits
        self.sizes = octave_sizes(rows, columns)
        rows_of, columns_of = zip(*self.sizes, strict=True)
        *self.starts, self.image_size = np.cumsum([0, *(LEVELS * r * c for r, c in self.sizes)]).tolist()
        pyramid: Any = kernels.Pyramid()
        pyramid.values = wp.empty(n_images * self.image_size, dtype=wp.float32, device=device)
        pyramid.image_size = self.image_size
        for name, values in (("starts", self.starts), ("rows", rows_of), ("columns", columns_of)):
            setattr(pyramid, name, wp.array(values, dtype=wp.int32, device=device))
        self.pyramid = pyramid
        self.grey = wp.empty((n_images, rows, columns), dtype=wp.uint8, device=device)
        self.half_smooth = wp.empty(n_images * 4 * rows * columns, dtype=wp.float32, device=device)
        self.number = wp.zeros(1, dtype=wp.int32, device=device)
        self.keys = wp.empty(roomy(1000 * n_images), dtype=wp.int64, device=device)
        self.filled = 0
        filters = [_half_gaussian(sigma) for sigma in _sigmas()]
        self.radii = [len(half) - 1 for half in filters]
        self.first_weights = [int(first) for first in np.cumsum([0, *map(len, filters)])]
        self.weights: Any = wp.array(np.concatenate(filters).astype(np.float32), dtype=wp.float32, device=device)
        self._commands = self._record()

    def fill(self, grey: Tensor) -> None:
        """Compute the scale spaces of images (B, H, W) uint8, B at most `n_images`."""
        images: Any = wp.from_torch(grey.contiguous())
        wp.copy(self.grey, images, count=grey.numel())
        if grey.shape[0] != self.filled:
            self.filled = grey.shape[0]
            for command, size in self._commands:
                command.set_dim((self.filled, *size))
        for command, _ in self._commands:
            command.launch()

    def find(self) -> NDArray[np.int64]:
        """Keys (K,) int64 of the extrema that pass the limits, ascending (see `key_of`)."""
        while True:
            self.number.zero_()
            for octave in range(1 + self.first_octave, len(self.sizes)):
                rows, columns = self.sizes[octave]
                shape = self.filled, LAYERS, rows - 2 * BORDER, columns - 2 * BORDER
                inputs = [self.pyramid, octave, self.limits]
                outputs = [self.number, self.keys]
                wp.launch(kernels.extrema_kernel, shape, inputs, outputs, device=self.device)
            number = int(self.number.numpy()[0])
            if number <= len(self.keys):
                return np.asarray(torch.unique(wp.to_torch(self.keys[:number])).cpu().numpy())
            self.keys = wp.empty(roomy(number), dtype=wp.int64, device=self.device)

    def _record(self) -> list[tuple[Any, tuple[int, int]]]:
        """The launches that fill the scale spaces, and how many threads of each work on an image."""
        commands: list[tuple[Any, tuple[int, int]]] = []

        def add(kernel: Any, octave: int, *inputs: Any) -> None:
            dim = (self.n_images, *self.sizes[octave])
            command = wp.launch(kernel, dim=dim, inputs=list(inputs), device=self.device, record_cmd=True)
            commands.append((command, self.sizes[octave]))

        def level_of(octave: int, level: int, half_smooth: bool = False) -> Any:
            """A level of the pyramid, or the memory for one smoothed along its rows only."""
            result: Any = kernels.Level()
            result.rows, result.columns = self.sizes[octave]
            result.values = self.half_smooth if half_smooth else self.pyramid.values
            result.image_size = 4 * self.rows * self.columns if half_smooth else self.image_size
            result.start = 0 if half_smooth else self.starts[octave] + level * result.rows * result.columns
            return result

        def smooth(octave: int, source: int, target: int) -> None:
            """From level to level of an octave, with the filter of the latter."""
            along_rows, along_columns = kernels_of[self.radii[target]]
            half = level_of(octave, 0, half_smooth=True)
            first = self.first_weights[target]
            add(along_rows, octave, level_of(octave, source), half, self.weights, first)
            add(along_columns, octave, half, level_of(octave, target), self.weights, first)

        # all before the first launch, so that their module is compiled once
        kernels_of = {
            radius: [kernels.smooth_kernel(radius, along_rows) for along_rows in (True, False)]
            for radius in sorted({*self.radii})
        }

        add(kernels.double_kernel, 0, self.grey, level_of(0, 0))
        smooth(0, 0, 0)
        for octave in range(len(self.sizes)):
            if octave > 0:
                add(kernels.halve_kernel, octave, level_of(octave - 1, LAYERS), level_of(octave, 0))
            searched = octave > self.first_octave
            for level in range(1, LEVELS if searched else LAYERS + 1):
                smooth(octave, level - 1, level)
        return commands


def octave_sizes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Rows and columns of the octaves that can hold a keypoint; the first has twice the image's size."""
    sizes = [(2 * rows, 2 * columns)]
    while min(sizes[-1]) > 2 * BORDER:
        sizes.append((sizes[-1][0] // 2, sizes[-1][1] // 2))
    return sizes[:-1]


def values_of_image(rows: int, columns: int) -> int:
    """How many values the scale space of an image has."""
    return LEVELS * sum(r * c for r, c in octave_sizes(rows, columns))


def _sigmas() -> list[float]:
    """Standard deviation of the filter that makes each level from the one before, the first from the doubled image."""
    total = [kernels.SIGMA * 2 ** (level / LAYERS) for level in range(LEVELS)]
    first = math.sqrt(kernels.SIGMA**2 - (2 * 0.5) ** 2)  # an input image is blurred by 0.5 of its pixels
    return [first, *(math.sqrt(b**2 - a**2) for a, b in pairwise(total))]


def _half_gaussian(sigma: float) -> NDArray[np.float64]:
    """Weights of a Gaussian filter from its middle outwards, truncated where `cv2.GaussianBlur` does."""
    radius = (round(8 * sigma + 1) | 1) // 2
    weights = np.exp(-(np.arange(-radius, radius + 1) ** 2) / (2 * sigma**2))
    return (weights / weights.sum())[radius:]


def roomy(n: int) -> int:
    """A power of two of at least n, so that buffers have few different sizes."""
    return 1 << max(10, (n - 1).bit_length())
