"""Names, thresholds of labels, splits, and options of sampling; light, so that the command line reads them quickly."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.lattices import Lattice, ViewLattice
from wheretolook.utils.errors import ConfigError, MapWarning, check_range, no_option

RELEASE = "release"  # name of the released dataset
RELEASE_FILE = "release.json"  # what a release was made from; the file that makes a dataset one
LOCK = ".lock"  # in a dataset's folder: held by stages that change it, shared by those that read it

LOCALIZED = "localized"
TOO_FEW_MATCHES = "too_few_matches"
NO_POSE = "no_pose"
CONTRADICTED = "contradicted"  # of a rig: there is a pose, but the images contradict the given rotations


Accuracy = tuple[float, float]
"""Limits of the position error (m) and of the orientation error (degrees)."""

THRESHOLDS = ((0.05, 0.4), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
"""Error limits in metres and degrees: the Long-Term Visual Localization benchmark's and the paper's finer one."""


ACCURACY: Accuracy = THRESHOLDS[0]


def checked_accuracy(accuracy: Sequence[float], distances_m: ArrayLike = ()) -> Accuracy:
    """Return limits of the errors in metres and degrees. Raises ConfigError unless they are two positive numbers.

    A `MapWarning` reports a limit above half the median of the landmarks' distances from the mapping cameras, if given.
    """
    try:
        limits = tuple(float(limit) for limit in accuracy)
    except (TypeError, ValueError):
        limits = ()
    if len(limits) != 2 or not all(limit > 0 for limit in limits):
        raise ConfigError("an accuracy has two positive limits", value=accuracy, fix="Give metres,degrees: 0.05,0.4.")
    if (
        np.size(distances_m)
        and limits[0] > (depth_m := float(np.median(np.asarray(distances_m, dtype=np.float64)))) / 2
    ):
        text = f"an accuracy of {limits[0]:g} m exceeds half the map's median depth of {depth_m:.2g} m; limits are in metres"
        warnings.warn(f"{text} and degrees: 5 cm and 0.4 degrees are 0.05,0.4", MapWarning, stacklevel=2)
    return limits


def threshold_key(threshold: tuple[float, float]) -> str:
    """Name of a pair of limits in column and metric names, such as "0.05m_0.4deg"."""
    return f"{threshold[0]:g}m_{threshold[1]:g}deg"


def threshold_label(key: str) -> str:
    """Display name of a `threshold_key`, such as "5 cm, 0.4°"."""
    metres, degrees = key.removesuffix("deg").split("m_")
    distance = f"{float(metres) * 100:g} cm" if float(metres) < 0.5 else f"{float(metres):g} m"
    return f"{distance}, {degrees}°"


ALL = "all"  # value of the column `scene` in rows over all scenes


Split = Literal["train", "val", "test"]  # scenes for training, validation and testing


@dataclass(frozen=True)
class SampleConfig(ViewLattice):
    """Settings of the sample stage.

    Args:
        keep: directions kept at each location, those that see most landmarks; 0 keeps all. The paper's K.
        min_visible: directions that see fewer landmarks are dropped. In the paper, those with "none or only a minimal
            number" (Sec. 3.2).
        max_locations: free locations to keep at most, drawn at random; 0 keeps all.
        max_directions: kept directions of each location to take at most, drawn at random; 0 takes all. One number, or
            one for each split, such as `{train: 50, val: 50, test: 100}`.
        seed: seed of what is drawn at random.
        cameras: number of cameras of a scene, each used at its own locations, with fields of view, sizes and aspect
            ratios drawn from the scene's seed; 0 uses the experiment's camera everywhere.
        any_lens: draw these from 25 to 120 degrees and 320 to 2,000 px, in place of 40 to 120 and 320 to 1,280.
        near_map: share of `max_locations`, 0 to 1, that is near mapping images, with directions near theirs, as
            photographs of a sequence are to each other; needs a grid of about 20 cm.

    Attributes:
        distinct_pixels: recorded with samples; landmarks are counted, several on a pixel as several.
        memory_gb: bound on the memory that counting takes on its device, in 10^9 bytes; two million landmarks fit.
    """

    lattice: Lattice = no_option("fibonacci")
    keep: int = 100
    min_visible: int = no_option(1)
    max_locations: int = 0
    max_directions: int | dict[Split, int] = 0
    seed: int = 0
    cameras: int = 0
    any_lens: bool = False
    near_map: float = 0.0
    distinct_pixels: bool = field(default=False, init=False)
    memory_gb: float = field(default=2.0, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("keep", "min_visible", "max_locations", "cameras"):
            check_range(f"sample.{name}", getattr(self, name), 0)
        check_range("sample.near_map", self.near_map, 0, 1)
        if self.near_map and not self.max_locations:
            fix = "Set sample.max_locations."
            raise ConfigError("near_map is a share of max_locations, which is 0", value=self.near_map, fix=fix)
        if self.any_lens and not self.cameras:
            raise ConfigError("any_lens draws cameras, of which there are none", value=True, fix="Set sample.cameras.")
        if isinstance(self.max_directions, dict) and set(self.max_directions) != set(get_args(Split)):
            fix = "Give one number, or one for each of train, val and test."
            raise ConfigError("sample.max_directions lacks or misnames a split", value=self.max_directions, fix=fix)
        check_range("sample.max_directions", min(map(self.directions_of, get_args(Split))), 0)

    def directions_of(self, split: Split) -> int:
        """`max_directions` for a split."""
        return self.max_directions[split] if isinstance(self.max_directions, dict) else self.max_directions
