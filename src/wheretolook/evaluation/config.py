"""Options of evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from wheretolook.errors import ConfigError
from wheretolook.visibility.config import OcclusionName, check_occlusion_names

THRESHOLDS = ((0.05, 0.4), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Error limits in metres and degrees: the Long-Term Visual Localization benchmark's and the paper's finer one."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Options of evaluation.

    Args:
        methods: methods to compare, keys of `wheretolook.scoring.SCORERS`; "mlp" stands for every weights file.
        weights: weights to evaluate; empty for all in the dataset's `weights` folder.
        split: whose scenes to evaluate on: "test", "val" or "train".
        top_n: how many of a location's best-scored viewpoints count; every value gives a row of the table.
        thresholds: pairs of limits, in metres and degrees, that both errors of a good viewpoint stay strictly under.
            The first pair is the label.
        seed: seed of the random method and of the bootstrap.
        resamples: bootstrap resamples of the locations, for 95 % intervals.
        occlusions: occlusion models to see the landmarks by, each scored apart: "mesh", "tsdf", "hidden-points",
            "none". Empty for the one that the viewpoints were sampled with, which is stored.
    """

    methods: tuple[str, ...] = ("random", "visible", "bins", "mlp")
    weights: tuple[Path, ...] = ()
    split: Literal["train", "val", "test"] = "test"
    top_n: tuple[int, ...] = (1, 5, 10)
    thresholds: tuple[tuple[float, float], ...] = THRESHOLDS
    seed: int = 0
    resamples: int = 2000
    occlusions: tuple[OcclusionName, ...] = ()

    def __post_init__(self) -> None:
        from wheretolook.scoring.registry import SCORERS

        unknown = [name for name in self.methods if name not in SCORERS]
        if unknown or not self.methods or len(set(self.methods)) < len(self.methods):
            known = f"There are {', '.join(SCORERS)}."
            raise ConfigError("methods must be known and named once", value=self.methods, fix=known)
        if self.split not in ("train", "val", "test"):
            raise ConfigError("unknown split", value=self.split, fix="Use train, val or test.")
        if not self.top_n or min(self.top_n) < 1 or len(set(self.top_n)) < len(self.top_n):
            raise ConfigError("top_n needs different numbers of at least 1", value=self.top_n)
        if not self.thresholds or min(limit for pair in self.thresholds for limit in pair) <= 0:
            raise ConfigError("thresholds needs pairs of positive limits", value=self.thresholds)
        if self.resamples < 1:
            raise ConfigError("resamples must be at least 1", value=self.resamples)
        check_occlusion_names(self.occlusions)


def threshold_key(threshold: tuple[float, float]) -> str:
    """Name of a pair of limits in column and metric names, such as "0.05m_0.4deg"."""
    return f"{threshold[0]:g}m_{threshold[1]:g}deg"


def threshold_label(key: str) -> str:
    """What `threshold_key` gives, for people: "5 cm, 0.4°"."""
    metres, degrees = key.removesuffix("deg").split("m_")
    distance = f"{float(metres) * 100:g} cm" if float(metres) < 0.5 else f"{float(metres):g} m"
    return f"{distance}, {degrees}°"
