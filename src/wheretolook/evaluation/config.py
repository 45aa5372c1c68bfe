"""Options of evaluation."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from wheretolook.errors import ConfigError
from wheretolook.visibility.config import OcclusionName, check_occlusion_names

THRESHOLDS = ((0.05, 0.4), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Error limits in metres and degrees: the Long-Term Visual Localization benchmark's and the paper's finer one."""


def _all_methods() -> tuple[str, ...]:
    from wheretolook.scoring.registry import SCORERS

    return tuple(SCORERS)


@dataclass(frozen=True)
class EvaluateConfig:
    """Options of evaluation.

    Args:
        methods: methods to compare, keys of `wheretolook.scoring.SCORERS`; all of them if not named. "mlp" stands for
            every weights file.
        weights: weights to evaluate; empty for all in the dataset's `weights` folder.
        split: whose scenes to evaluate on: "test", "val" or "train".
        top_n: how many of a location's best-scored viewpoints count; every value gives a row of the table.
        thresholds: pairs of limits, in metres and degrees, that both errors of a good viewpoint stay strictly under.
            The first pair is the label.
        seed: seed of the random method, of the bootstrap and of the paired test.
        resamples: bootstrap resamples of the locations, for 95 % intervals, and sign flips of the paired test.
        occlusions: occlusion models to see the landmarks by, each scored apart: "mesh", "tsdf", "hidden-points",
            "none". Empty for the one that the viewpoints were sampled with, which is stored.
        candidates: sets of views to choose from, each tabulated apart. 0 is for all labelled directions of a location,
            as a planner meets them, K > 0 for those among the K that see most landmarks (of all directions, labelled or
            not), as in the paper.
        reference: method that every other is compared with, by name and inputs as in the table, such as "bins" or
            "mlp 2d+z". Empty for the learned one with the inputs "2d+3d", or else the first learned one.
    """

    methods: tuple[str, ...] = field(default_factory=_all_methods)
    weights: tuple[Path, ...] = ()
    split: Literal["train", "val", "test"] = "test"
    top_n: tuple[int, ...] = (1, 5, 10)
    thresholds: tuple[tuple[float, float], ...] = THRESHOLDS
    seed: int = 0
    resamples: int = 2000
    occlusions: tuple[OcclusionName, ...] = ()
    candidates: tuple[int, ...] = (0,)
    reference: str = ""

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
        if not self.candidates or min(self.candidates) < 0 or len(set(self.candidates)) < len(self.candidates):
            raise ConfigError(
                "candidates needs different numbers of at least 0", value=self.candidates,
                fix="0 is for all directions, 100 for the 100 that see most landmarks.",
            )  # fmt: skip
        check_occlusion_names(self.occlusions)


def candidates_label(best: int) -> str:
    """Name of a candidate set in the column `candidates`: "all" for 0, else such as "best 100"."""
    return f"best {best}" if best else "all"


def threshold_key(threshold: tuple[float, float]) -> str:
    """Name of a pair of limits in column and metric names, such as "0.05m_0.4deg"."""
    return f"{threshold[0]:g}m_{threshold[1]:g}deg"


def threshold_label(key: str) -> str:
    """What `threshold_key` gives, for people: "5 cm, 0.4°"."""
    metres, degrees = key.removesuffix("deg").split("m_")
    distance = f"{float(metres) * 100:g} cm" if float(metres) < 0.5 else f"{float(metres):g} m"
    return f"{distance}, {degrees}°"
