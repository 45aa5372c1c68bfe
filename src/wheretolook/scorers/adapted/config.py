"""Settings of adapting weights to a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class AdaptConfig:
    """How weights are adapted to a scene.

    Args:
        scene: name of the scene; may be left out where the dataset has one only.
        map: instead of a scene: folder of a COLMAP model, in metres with z up, whose photographs are left out.
        images: folder of the map's photographs, to extract their features anew.
        database: features that the map was made from: COLMAP's `database.db`, or hloc's in HDF5. Empty for those next to
            the map.
        weights: file of weights of `set` to start from; empty for those that ship.
        out: file of weights to write; empty for `<data>/<name>/adapted/<scene>.safetensors`, of a map
            `<data>/checks/<map>/adapted.safetensors`.
        minutes: time to label rendered views in, if the scene has a mesh and its views have no labels yet.
        seed: which locations are labelled first, and which views are left out together.
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
            fix = "Leave images out to use the features that the map was made from, database to extract them anew."
            raise ConfigError("features come from a database or from images", value=str(self.images), fix=fix)
        if not 0 < self.minutes < float("inf"):
            raise ConfigError("the time to label views in is above 0 minutes", value=self.minutes)
        if self.seed < 0:
            raise ConfigError("seed must not be negative", value=self.seed)
