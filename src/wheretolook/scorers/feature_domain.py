"""Which weights suit the local features of a map."""

from __future__ import annotations

import warnings
from pathlib import Path

from wheretolook.utils.errors import OutOfRangeWarning
from wheretolook.utils.shipped import WEIGHTS, or_shipped

SUBSTITUTES = {"disk": "aliked", "xfeat": "aliked", "superpoint": "aliked"}
"""Features whose weights are better than those by SIFT where a map's own features have none: measured on val scenes by
DISK and XFeat (docs/features.md), assumed for SuperPoint."""


def warn_of_features(of_map: str, weights: Path, stacklevel: int) -> None:
    """Warn if a map's landmarks have other local features than those the weights were trained on."""
    from wheretolook.training.weights import features_of_weights

    trained_on = features_of_weights(weights)
    if not of_map or of_map in trained_on:
        return
    text = f"the weights {weights.name} were trained on maps by {', '.join(trained_on)}, and this map is by {of_map}"
    fix = "docs/features.md has the measured losses; `wheretolook check` measures them on your map"
    theirs = SUBSTITUTES.get(of_map, of_map)
    if theirs not in trained_on and or_shipped(f"{WEIGHTS}/{theirs}").is_dir():
        fix = f"Better weights are bundled, {WEIGHTS}/{theirs}, and used if none are given; {fix}"
    warnings.warn(f"{text}. {fix}.", OutOfRangeWarning, stacklevel=stacklevel + 1)
