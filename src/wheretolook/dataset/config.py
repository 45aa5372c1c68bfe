"""Names, thresholds of labels, and options of sampling."""

from __future__ import annotations

from collections.abc import Sequence

from wheretolook.utils.errors import ConfigError

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


def checked_accuracy(accuracy: Sequence[float]) -> Accuracy:
    """Return limits of the errors in metres and degrees. Raises ConfigError unless they are two positive numbers."""
    try:
        limits = tuple(float(limit) for limit in accuracy)
    except (TypeError, ValueError):
        limits = ()
    if len(limits) != 2 or not all(limit > 0 for limit in limits):
        raise ConfigError("an accuracy has two positive limits", value=accuracy, fix="Give metres,degrees: 0.05,0.4.")
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
