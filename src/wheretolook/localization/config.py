"""Options of localization and labels, and the versions that decide a label."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from wheretolook.utils.errors import ConfigError, check_choice, check_positive, check_range, no_option
from wheretolook.utils.files import sha256
from wheretolook.utils.package import VERSION


@dataclass(frozen=True)
class LocalizerConfig:
    """Settings of matching and pose estimation.

    Args:
        method: "first" for the pose that RANSAC finds, as in the paper and its labels; "hypotheses" for the best of
            several, each found among matches that the others do not explain, and matched again under its guidance.
        max_ratio: Lowe's ratio for SIFT: maximum ratio of the descriptor distances to the nearest and second nearest
            landmark.
        min_similarity: minimum cosine of mutual nearest neighbours for learned features; by default the extractor's.
        lightglue: file of LightGlue weights for the map's features (aliked_lightglue.pth), or kornia for its copy. A
            query is then matched with mapping images, as in hloc, instead of with landmarks: with the five that observe most of
            the landmarks matched first. Needs a map with its
            database (`mapping.keep_database`) and the extra `learned`.
        max_error_px: maximum reprojection error of an inlier in RANSAC.
        min_inliers: inliers that a pose needs: RANSAC finds some pose with a few for almost any image.
        seed: seed of RANSAC, the same for every image, so that a label depends only on its viewpoint; also of
            `label.appearance`.

    Attributes:
        min_matches: matches needed to estimate a pose: four determine and check one.
        confidence: RANSAC stops when it has drawn three inliers together with this probability.
        min_trials: minimum trials of RANSAC, as in COLMAP.
        max_trials: maximum trials of RANSAC, as in COLMAP: with a tenth of inliers it misses one pose in 20,000.
    """

    method: Literal["first", "hypotheses"] = "first"
    max_ratio: float = no_option(0.85)
    min_similarity: float | None = None
    lightglue: str = ""
    min_matches: int = field(default=4, init=False)
    max_error_px: float = no_option(8.0)
    min_inliers: int = no_option(10)
    seed: int = 0
    confidence: float = field(default=0.9999, init=False)
    min_trials: int = field(default=100, init=False)
    max_trials: int = field(default=10_000, init=False)

    def __post_init__(self) -> None:
        check_choice("localizer method", self.method, ("first", "hypotheses"))
        check_range("max_ratio", self.max_ratio, 1e-9, 1)
        if self.min_similarity is not None:
            check_range("min_similarity", self.min_similarity, -1, 1)
        check_range("min_inliers", self.min_inliers, 4)
        check_positive("max_error_px", self.max_error_px)

    def record(self) -> dict[str, Any]:
        """Settings that decide the labels, as JSON values."""
        record = asdict(self)
        # options at their defaults that older labels do not have
        if self.method == "first":
            del record["method"]
        if self.min_similarity is None:
            del record["min_similarity"]
        if not self.lightglue:
            del record["lightglue"]
        elif Path(self.lightglue).is_file():
            record["lightglue"] = sha256(Path(self.lightglue))
        return record


@dataclass(frozen=True)
class LabelConfig:
    """Settings of the label stage.

    Args:
        localizer: matching and pose estimation.
        engine: local, in processes on this machine, or ray, on a Ray cluster (needs `pip install 'wheretolook[ray]'`). Both give the
            same labels.
        ray_address: address of the Ray cluster, such as "auto" on one of its machines, or "ray://head:10001" from
            another (needs `pip install 'ray[client]'`); empty starts one on this machine.
        workers: worker processes on this machine; 0 for one per CPU core, or one per GPU where all steps run there.
        shard_size: viewpoints in a shard; at least 8,192 if all steps run on a GPU. An interruption loses the shards in progress.
        store_matches: store the rows of the landmarks that each view matched (matched_rows) and of the inliers
            (inlier_rows); needed to train matchability.
        appearance: 0 to 1, the highest strength at which queries are made to resemble photographs: exposure, white
            balance, vignetting, noise, motion blur, defocus, JPEG, and people in front. Each view's is drawn up to it
            and stored (appearance).
        changes: 0 to 1, how much generated scenes change after they are mapped: things are moved or removed, lamps are
            brighter or dimmer. The views of about half of the locations show the changed scene, which is stored
            (changes). Only the label command takes it.
        store_pixels: store also the pixels of the matches (matched_pixels); needed to localize several looks jointly.
    """

    localizer: LocalizerConfig = field(default_factory=LocalizerConfig)
    engine: Literal["local", "ray"] = "local"
    ray_address: str = ""
    workers: int = 0
    shard_size: int = 256
    store_matches: bool = False
    store_pixels: bool = False
    appearance: float = 0.0
    changes: float = 0.0

    def __post_init__(self) -> None:
        check_choice("label.engine", self.engine, ("local", "ray"))
        if self.engine == "ray" and self.localizer.lightglue:
            fix = "Use label.engine local, or leave label.localizer.lightglue out."
            raise ConfigError("LightGlue reads the map's database, which does not travel to Ray's machines", fix=fix)
        check_range("workers", self.workers, 0)
        check_range("shard_size", self.shard_size, 1)
        if not 0 <= self.appearance <= 1:
            fix = "Give 0 for plain renderings, 0.3 for good photographs, up to 1 for poor ones."
            raise ConfigError("label.appearance must be within 0 and 1", value=self.appearance, fix=fix)
        check_range("label.changes", self.changes, 0, 1)


@cache
def versions() -> dict[str, str]:
    """Versions of the packages that decide a label."""
    result = {"wheretolook": VERSION}
    for package in ("poselib", "pycolmap", "opencv-python-headless", "warp-lang", "numpy", "torch"):
        try:
            result[package] = version(package)
        except PackageNotFoundError:  # installed some other way
            result[package] = "unknown"
    return result
