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
        weights: file of weights of `set` to start from; empty for those that ship.
        out: file of weights to write; empty for `<data>/<name>/adapted/<scene>.safetensors`.
        minutes: time to label views in, if the scene's have no labels yet.
        seed: which locations are labelled first, and which views are left out together.
    """

    scene: str = ""
    weights: Path | None = None
    out: Path | None = None
    minutes: float = 10.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.minutes < float("inf"):
            raise ConfigError("the time to label views in is above 0 minutes", value=self.minutes)
