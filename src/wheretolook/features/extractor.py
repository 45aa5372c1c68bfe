"""Keypoints, kinds of descriptors, and extractors with their options; an extractor's code is imported when it runs."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError, check_choice, check_positive, check_range, no_option
from wheretolook.utils.files import sha256
from wheretolook.utils.processes import WorkerPool


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one image."""

    pixels: NDArray[np.float32]  # (N, 2) (x, y) in pixels; (0.5, 0.5) is the centre of the top-left pixel
    # (N, D) of unit length; of SIFT (N, 128) RootSIFT (Arandjelovic and Zisserman, CVPR 2012)
    descriptors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def none(cls, dimension: int = 128) -> Keypoints:
        """No keypoints, with descriptors of a dimension."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, dimension), np.float32))


Stored = tuple[NDArray[np.float32], NDArray[Any]]
"""Keypoints of an image as stored in files: pixels (K, 2), and descriptors (K, D) as by `DescriptorKind.store`."""


@dataclass(frozen=True)
class DescriptorKind:
    """Descriptors of one extractor, or of several equivalent ones. All are compared by their angle.

    A kind is either stored as COLMAP stores SIFT, as bytes (512 times non-negative unit descriptors), and matched by
    Lowe's ratio; or stored as float16 unit descriptors, as hloc stores learned ones, and matched where both are each
    other's nearest with at least `min_similarity`.
    """

    name: str  # in maps, weights and messages
    dimension: int  # numbers in a descriptor
    stored_as: Literal["uint8", "float16"]
    min_similarity: float = 0.0  # minimum cosine of mutual nearest neighbours, if not matched by ratio
    colmap_type: int = -1  # its `FeatureExtractorType` in databases of COLMAP 4; -1 for none

    @property
    def in_bytes(self) -> bool:
        """Whether descriptors are stored as bytes and matched by Lowe's ratio."""
        return self.stored_as == "uint8"

    @property
    def columns(self) -> int:
        """Bytes of a descriptor in a COLMAP database, which stores floating-point numbers in single precision."""
        return self.dimension * (1 if self.in_bytes else 4)

    def store(self, descriptors: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """Convert unit descriptors (N, D) to the format of files and matchers."""
        return quantize_descriptors(descriptors) if self.in_bytes else descriptors.astype(np.float16)

    def restore(self, stored: NDArray[Any]) -> NDArray[np.float32]:
        """Convert stored descriptors to (N, D) float32, of unit length up to rounding."""
        return (stored / 512).astype(np.float32) if self.in_bytes else stored.astype(np.float32)

    def none(self) -> NDArray[Any]:
        """Stored descriptors of no keypoints, (0, D)."""
        return np.zeros((0, self.dimension), dtype=self.stored_as)


def quantize_descriptors(descriptors: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Unit descriptors (N, D) as COLMAP stores them, (N, D) uint8: 512 times the value, rounded, at most 255."""
    values = 512 * descriptors
    np.rint(values, out=values)
    np.clip(values, 0, 255, out=values)  # in place: new arrays of this size take longer than the computation
    return values.astype(np.uint8)


def unit_descriptors(descriptors: NDArray[Any]) -> NDArray[np.float32]:
    """Stored descriptors (N, D), e.g. uint8, as float32 of unit length (rows of zeros stay zero)."""
    values = descriptors.astype(np.float32)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    values /= np.where(length > 0, length, 1)
    return values


class Extraction(Protocol):
    """An extractor on its device."""

    batch: int  # images of 640 x 480 in a batch; 1 on a CPU

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Extract at most `max_keypoints` keypoints from each image (H, W, 3) uint8; all images have one size.

        The result for an image does not depend on the others. Raises ValueError for another shape or type.
        """
        ...


@dataclass(frozen=True)
class Extractor:
    """An extractor; without `build`, one whose keypoints are only read from files of other programs."""

    name: str  # in options: `mapping.extractor.method`
    descriptors: DescriptorKind
    build: str = ""  # module of this package, and in it what makes an `Extraction` of an `ExtractorConfig` and a device
    weights: str = ""  # usual name of the file of a network's weights; "" for none
    urls: tuple[str, ...] = ()  # of these weights
    lightglue: str = ""  # name of the extractor in kornia's LightGlue; "" if unsupported


SIFT = DescriptorKind("sift", 128, "uint8", colmap_type=0)
XFEAT = DescriptorKind("xfeat", 64, "float16", min_similarity=0.82)
# hloc's "NN-superpoint" matches up to a distance of 0.7 between unit descriptors: 1 - 0.7^2 / 2
SUPERPOINT = DescriptorKind("superpoint", 256, "float16", min_similarity=0.755)

EXTRACTORS = {
    extractor.name: extractor
    for extractor in (
        Extractor("opencv", SIFT, "sift:OpenCvSift"),
        Extractor("colmap", SIFT, "sift:ColmapSift"),
        Extractor(
            "aliked",
            DescriptorKind("aliked", 128, "float16", min_similarity=0.8, colmap_type=1),
            "learned:Aliked",
            "aliked-n16rot.pth",
            (
                "https://huggingface.co/kornia/aliked/resolve/main/aliked-n16rot.pth",
                "https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-n16rot.pth",
            ),
            lightglue="aliked",
        ),
        Extractor(
            "disk",
            DescriptorKind("disk", 128, "float16", min_similarity=0.8),
            "learned:Disk",
            "depth-save.pth",
            (
                "https://huggingface.co/kornia/disk/resolve/main/depth-save.pth",
                "https://raw.githubusercontent.com/cvlab-epfl/disk/master/depth-save.pth",
            ),
            lightglue="disk",
        ),
        Extractor(
            "xfeat",
            XFEAT,
            "learned:XFeat",
            "xfeat.pt",
            ("https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt",),
            lightglue="xfeat",
        ),
        Extractor("superpoint", SUPERPOINT, lightglue="superpoint"),
        # ALIKED of another network, and LoMa's descriptors by DeDoDe (Nordström et al. 2026), matched as by COLMAP 4.2
        Extractor("aliked-n32", DescriptorKind("aliked-n32", 128, "float16", min_similarity=0.8, colmap_type=2)),
        Extractor("loma-b", DescriptorKind("loma-b", 256, "float16", min_similarity=0.85, colmap_type=3)),
        Extractor("loma-b128", DescriptorKind("loma-b128", 128, "float16", min_similarity=0.85, colmap_type=4)),
    )
}
KINDS = {extractor.descriptors.name: extractor.descriptors for extractor in EXTRACTORS.values()}


def runnable_extractors() -> tuple[str, ...]:
    """Names of the extractors that can be run."""
    return tuple(name for name, extractor in EXTRACTORS.items() if extractor.build)


def kind_of(method: str) -> DescriptorKind:
    """The descriptors of an extractor by its name."""
    return EXTRACTORS[method].descriptors


def check_image(rgb: NDArray[np.uint8]) -> None:
    """Raise ValueError unless an image is (H, W, 3) uint8."""
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"expected an (H, W, 3) uint8 image, got {rgb.shape} {rgb.dtype}")


@dataclass(frozen=True)
class ExtractorConfig:
    """Settings of the keypoint extractor.

    Args:
        method: extractor: SIFT by opencv or colmap, or the learned aliked, disk and xfeat, which need
            `pip install 'wheretolook[learned]'`. `opencv` gives nearly the same keypoints as `colmap`, COLMAP's own
            extraction on the CPU, in 40 % of the time; on a GPU, Warp kernels give OpenCV's up to rounding.
        first_octave: first octave of SIFT: -1 doubles the image first, which gives about three times as many (and smaller)
            keypoints, for `colmap` at four times the cost; 0 starts at the image's own size. COLMAP's default is -1.
        max_keypoints: maximum number of keypoints per image. `colmap` prefers large scales, `opencv` strong
            contrast, learned ones high scores.
        peak_threshold: minimum contrast of SIFT keypoints (difference of Gaussians, grey values in [0, 1]). COLMAP's default is
            0.02 / 3.
        weights: weights file of a learned extractor as published by its authors (aliked-n16rot.pth, depth-save.pth of
            DISK, xfeat.pt). By default kornia's copy, from its cache or downloaded.

    Attributes:
        edge_threshold: maximum ratio of principal curvatures: the value of Lowe 2004 (section 4.1), COLMAP and OpenCV.
    """

    method: str = "opencv"
    first_octave: int = no_option(-1)
    max_keypoints: int = 2048
    peak_threshold: float = no_option(0.02 / 3)
    weights: str = ""
    edge_threshold: float = field(default=10.0, init=False)

    def __post_init__(self) -> None:
        check_choice("extractor method", self.method, runnable_extractors())
        if self.weights and not EXTRACTORS[self.method].weights:
            raise ConfigError("this extractor has no weights", value=self.weights, fix="Leave extractor.weights out.")
        check_choice("first_octave", self.first_octave, (-1, 0))
        check_range("max_keypoints", self.max_keypoints, 1)
        check_positive("peak_threshold", self.peak_threshold)

    def record(self) -> dict[str, Any]:
        """Settings that decide the keypoints, as JSON values; weights by their checksum."""
        record = asdict(self)
        path = record.pop("weights")
        if path:
            record["weights_sha256"] = sha256(Path(path)) if Path(path).is_file() else None
        return record


class KeypointExtractor:
    """Extracts keypoints with any extractor of `wheretolook.features.extractor`, on a CPU core or a GPU.

    Raises ConfigError if kornia, a network's weights or the device is missing.
    """

    def __init__(self, config: ExtractorConfig, device: str = "cpu") -> None:
        self.config = config
        module, _, name = EXTRACTORS[config.method].build.partition(":")
        build = getattr(import_module(f"{__package__}.{module}"), name)
        self._extraction: Extraction = build(config, device)
        self.on_gpu = self._extraction.batch > 1

    def batch_of(self, width: int, height: int) -> int:
        """Number of images of a size in a batch: fewer large ones, which take more GPU memory."""
        return max(1, self._extraction.batch * 640 * 480 // (width * height))

    def extract(self, rgb: NDArray[np.uint8]) -> Keypoints:
        """Extract at most `max_keypoints` keypoints from an image (H, W, 3) uint8; their order depends only on the image.

        Raises ValueError if it has another shape or type.
        """
        return self.extract_batch([rgb])[0]

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Extract keypoints from images (H, W, 3) uint8 of one size, on a GPU in one batch. See `extract`."""
        return self._extraction.extract_batch(images)

    def extract_many(
        self, images: Iterable[NDArray[np.uint8]], processes: WorkerPool
    ) -> Generator[Keypoints, None, None]:
        """Yield keypoints of many images (H, W, 3) uint8 in their order, from worker processes or GPU batches.

        Only a few images are read ahead. Processes, as pycolmap's extractor holds the interpreter lock; the result does
        not depend on their number.
        """
        if self.on_gpu:
            source = iter(images)
            for first in source:
                more = self.batch_of(first.shape[1], first.shape[0]) - 1
                yield from self.extract_batch([first, *islice(source, more)])
        elif processes.workers <= 1:
            yield from map(self.extract, images)
        else:
            yield from processes.map(_extract_in_worker, ((self.config, rgb) for rgb in images))


_extractor_of = lru_cache(maxsize=1)(KeypointExtractor)


def _extract_in_worker(job: tuple[ExtractorConfig, NDArray[np.uint8]]) -> Keypoints:
    config, rgb = job
    return _extractor_of(config).extract(rgb)
