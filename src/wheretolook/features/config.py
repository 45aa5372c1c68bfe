"""Settings of the keypoint extractor."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from wheretolook.features.opencv_sift import EDGE_THRESHOLD, MAX_KEYPOINTS, PEAK_THRESHOLD
from wheretolook.features.registry import all_extractors, runnable_extractors
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import sha256
from wheretolook.utils.validation import check_choice, check_positive, check_range


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
    first_octave: int = -1
    max_keypoints: int = MAX_KEYPOINTS
    peak_threshold: float = PEAK_THRESHOLD
    weights: str = ""
    edge_threshold: float = field(default=EDGE_THRESHOLD, init=False)

    def __post_init__(self) -> None:
        check_choice("extractor method", self.method, runnable_extractors())
        if self.weights and not all_extractors()[self.method].weights:
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
