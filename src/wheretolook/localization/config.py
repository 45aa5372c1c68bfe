"""Options of labelling."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import sha256


@dataclass(frozen=True)
class LocalizerConfig:
    """Settings of matching and pose estimation.

    Args:
        max_ratio: Lowe's ratio, for SIFT: below it, a match counts. The nearest landmark's descriptor distance over the
            second nearest's.
        min_similarity: of learned features: a keypoint and a landmark that are each other's nearest match if the cosine
            between their descriptors is at least this; the extractor's own limit if none is given.
        lightglue: file of LightGlue's weights for the map's features (aliked_lightglue.pth), or kornia for its copy. A
            query is then matched with the mapping images that see most of the landmarks it seems to show, as hloc
            localizes, instead of with landmarks. Needs a map with its database (`map.keep_database`) and the extra
            `learned`.
        lightglue_images: how many mapping images that is.
        max_error_px: reprojection error under which RANSAC counts a match as an inlier.
        min_inliers: inliers that a pose needs. With fewer it is taken for an accident: RANSAC finds some pose for
            almost any image.
        seed: seed of RANSAC. The same for every image, so that a label depends on its viewpoint alone.

    Attributes:
        min_matches: with fewer matches no pose is sought; four is the least that determines and checks one.
        confidence: RANSAC stops when it has drawn three inliers at once with this probability, if no pose has more
            inliers than the best so far.
        min_trials: trials of RANSAC at least, as of COLMAP's.
        max_trials: trials of RANSAC at most, as of COLMAP's: where a tenth of the matches are inliers, it misses one
            pose in 20,000.
    """

    max_ratio: float = 0.85
    min_similarity: float | None = None
    lightglue: str = ""
    lightglue_images: int = 5
    min_matches: int = field(default=4, init=False)
    max_error_px: float = 8.0
    min_inliers: int = 10
    seed: int = 0
    confidence: float = field(default=0.9999, init=False)
    min_trials: int = field(default=100, init=False)
    max_trials: int = field(default=10_000, init=False)

    def __post_init__(self) -> None:
        if not 0 < self.max_ratio <= 1:
            raise ConfigError("max_ratio must be in (0, 1]", value=self.max_ratio)
        if self.min_similarity is not None and not -1 <= self.min_similarity <= 1:
            raise ConfigError("min_similarity is a cosine, -1 to 1", value=self.min_similarity)
        if self.lightglue_images < 1:
            raise ConfigError("lightglue_images must be at least 1", value=self.lightglue_images)
        if self.min_inliers < 4 or self.max_error_px <= 0:
            raise ConfigError(
                "the localizer needs min_inliers >= 4 and max_error_px > 0", value=(self.min_inliers, self.max_error_px)
            )

    def record(self) -> dict[str, Any]:
        """What decides which labels come out, as JSON values."""
        record = asdict(self)
        # options that older labels do not know, where they leave everything as it was
        if self.min_similarity is None:
            del record["min_similarity"]
        if not self.lightglue:
            del record["lightglue"], record["lightglue_images"]
        elif Path(self.lightglue).is_file():  # what is in it, not where it lies
            record["lightglue"] = sha256(Path(self.lightglue))
        return record


@dataclass(frozen=True)
class LabelConfig:
    """Settings of the label stage.

    Args:
        localizer: matching and pose estimation.
        engine: where labels are made: local, in processes here, or ray, on a Ray cluster. Both give the same labels;
            ray needs `pip install ray`.
        ray_address: address of the Ray cluster; empty starts one on this machine. Such as "auto" on one of its
            machines, or "ray://head:10001" from elsewhere (which needs `pip install 'ray[client]'`).
        workers: worker processes on this machine; 0 for one on each CPU core that it may use.
        shard_size: viewpoints in a shard; on a GPU at least 16 for each of several cameras. An interruption loses at
            most the shards that were being labelled.
        store_matches: keep which landmarks each view matched; needed to learn matchability. Their rows are in
            the column matched_rows, those that agree with the view's pose in inlier_rows.
        store_pixels: keep also where in its image each view matched them, in the column matched_pixels; needed to
            localize several looks from a place together.
    """

    localizer: LocalizerConfig = field(default_factory=LocalizerConfig)
    engine: Literal["local", "ray"] = "local"
    ray_address: str = ""
    workers: int = 0
    shard_size: int = 256
    store_matches: bool = False
    store_pixels: bool = False

    def __post_init__(self) -> None:
        if self.engine not in ("local", "ray"):
            raise ConfigError("unknown label.engine", value=self.engine, fix="Use local or ray.")
        if self.engine == "ray" and self.localizer.lightglue:
            fix = "Use label.engine local, or leave label.localizer.lightglue out."
            raise ConfigError("LightGlue reads the map's database, which does not travel to Ray's machines", fix=fix)
        if self.workers < 0 or self.shard_size < 1:
            raise ConfigError("workers must be >= 0 and shard_size >= 1", value=(self.workers, self.shard_size))
