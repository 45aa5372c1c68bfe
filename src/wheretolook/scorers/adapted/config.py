"""Settings of adapting weights to a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.validation import check_positive, check_range


@dataclass(frozen=True)
class AdaptConfig:
    """How weights are adapted to a scene.

    Args:
        scene: name of the scene; may be empty if the dataset has only one.
        map: instead of a scene: folder of a COLMAP model, in metres with z up, whose photographs are held out.
        images: folder of the map's photographs, to extract their features again.
        database: features that the map was made from: COLMAP's `database.db`, or hloc's in HDF5. Empty for those next to
            the map.
        weights: file of weights of `set` to start from; empty for the bundled ones.
        out: file of weights to write; empty for `<data>/<name>/adapted/<scene>.safetensors`, of a map
            `<data>/checks/<map>/adapted.safetensors`.
        minutes: time for labelling rendered views, if the scene has a mesh and its views have no labels yet.
        seed: decides which locations are labelled first, and which views are held out together.
    """

    scene: str = ""
    map: Path | None = None
    images: Path | None = None
    database: Path | None = None
    weights: Path | None = None
    out: Path | None = None
    minutes: float = 10.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.scene and self.map is not None:
            raise ConfigError("weights are adapted to a scene or to a map", value=self.scene, fix="Give one of them.")
        if self.images is not None and self.database is not None:
            raise ConfigError(
                "features come from a database or from images", value=self.images, fix="Give one of them."
            )
        check_positive("minutes", self.minutes)
        check_range("seed", self.seed, 0)
