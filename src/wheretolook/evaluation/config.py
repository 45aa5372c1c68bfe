"""Options of evaluation, and where its files are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from wheretolook.dataset.config import THRESHOLDS
from wheretolook.dataset.layout import Dataset
from wheretolook.scorers.registry import methods_named, scorers
from wheretolook.utils.errors import ConfigError, check_choice, check_positive, check_range, no_option
from wheretolook.utils.package import or_shipped
from wheretolook.visibility.config import check_occlusion_names

SCORES_CSV = "scores.csv"
SCORES_MD = "scores.md"
SCORES_PNG = "scores.png"
CALIBRATION_CSV = "calibration.csv"
"""Files of an evaluation, in `<dataset>/results/` and as artifacts of its run."""

VARIANTS_CSV = "variants.csv"
"""In a release's `results/`: scores of the networks for all inputs, as `scores.csv`, before one was chosen to ship."""


def _all_methods() -> tuple[str, ...]:
    return tuple(name for name, method in scorers().items() if not method.only_if_named)


@dataclass(frozen=True)
class EvaluateConfig:
    """Options of evaluation.

    Args:
        methods: methods to compare, by name or family, such as set and mlp. See `wheretolook evaluate --list-methods`;
            none for all but those that are compared only if named.
        weights: files of weights to evaluate; empty for all in the dataset's `weights` folder.
        split: whose scenes to evaluate on: "test", "val" or "train".
        top_n: how many of a location's best-scored viewpoints count. Every value gives a row of the table.
        thresholds: limits in metres and degrees that both errors of a good viewpoint stay under. Pairs; strictly under;
            the first pair is the label.
        seed: seed of the random method, of the bootstrap and of the paired test.
        resamples: bootstrap resamples of the locations, for 95 % intervals, and sign flips of the paired test.
        occlusions: occlusion models to see the landmarks by, each scored apart. "mesh", "tsdf", "hidden-points",
            "none"; empty for the one that the viewpoints were sampled with, which is stored.
        candidates: sets of views to choose from, each tabulated apart. 0 is for all labelled directions of a location,
            as a planner uses them, K > 0 for those among the K that see most landmarks (of all directions, labelled or
            not), as in the paper.
        block_m: side of the squares of floor whose locations are resampled together, in metres. For intervals and
            tests, as neighbours see the same landmarks; 0 takes each location for independent.
        heading: heading of the method "forward": one direction, or the waypoints of a path. In the world; the direction
            of travel nearest to a location is the heading there. Empty for a horizontal heading drawn for each
            location.
        photographs: whether photographs that were held out of the scenes' maps are views, too, as by
            `wheretolook check`; in rows of their own, with "photographs" in the column `candidates`.
        anywhere: allow weights adapted to another scene.
        reference: method that every other is compared with, by its name, such as "bins" or "mlp-2d+z". Empty for
            "set", or else "mlp-2d+3d", or else the first learned one.
    """

    methods: tuple[str, ...] = field(default_factory=_all_methods)
    weights: tuple[Path, ...] = ()
    split: Literal["train", "val", "test"] = "test"
    top_n: tuple[int, ...] = no_option((1, 5, 10))
    thresholds: tuple[tuple[float, float], ...] = no_option(THRESHOLDS)
    seed: int = no_option(0)
    resamples: int = no_option(2000)
    occlusions: tuple[str, ...] = ()
    candidates: tuple[int, ...] = (0,)
    block_m: float = no_option(1.0)
    heading: tuple[tuple[float, float, float], ...] = no_option(())
    photographs: bool = False
    anywhere: bool = False
    reference: str = no_option("")

    def __post_init__(self) -> None:
        object.__setattr__(self, "weights", tuple(map(or_shipped, self.weights)))
        methods_named(self.methods, scorers())
        check_choice("evaluate.split", self.split, ("train", "val", "test"))
        for name, least in (("seed", 0), ("block_m", 0), ("resamples", 1)):
            check_range(f"evaluate.{name}", getattr(self, name), least)
        for limit in (limit for pair in self.thresholds for limit in pair):
            check_positive("a limit of evaluate.thresholds", limit)
        check_range("the smallest of evaluate.top_n", min(self.top_n, default=0), 1)
        check_range("the smallest of evaluate.candidates", min(self.candidates, default=-1), 0)
        for name in ("thresholds", "top_n", "candidates"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ConfigError(f"evaluate.{name} must differ, and there must be one", value=values)
        check_heading(self.heading)
        check_occlusion_names(self.occlusions)


def check_heading(heading: Sequence[Sequence[float]]) -> None:
    """Raise a ConfigError unless it is empty, one direction, or waypoints of which no two in a row are the same."""
    values = np.asarray(heading, dtype=np.float64).reshape(-1, 3)
    steps = np.diff(values, axis=0) if len(values) > 1 else values
    if not np.isfinite(values).all() or (np.abs(steps).sum(1) == 0).any():
        fix = "Give a direction such as [[1, 0, 0]], or waypoints such as [[0, 0, 1], [2, 0, 1], [2, 3, 1]]."
        raise ConfigError("a heading is one direction, or waypoints that differ", value=heading, fix=fix)


def candidates_label(best: int) -> str:
    """Name of a candidate set in the column `candidates`: "all" for 0, else such as "best 100"."""
    return f"best {best}" if best else "all"


def results_folder(dataset: Dataset, config: EvaluateConfig) -> Path:
    """Return the folder of an evaluation's files: `<dataset>/results/`, and a folder in it for other splits than test."""
    folder = dataset.root / "results"
    return folder if config.split == "test" else folder / config.split
