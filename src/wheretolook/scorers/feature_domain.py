"""Which weights suit the local features of a map."""

from __future__ import annotations

import warnings
from pathlib import Path

from wheretolook.utils.errors import OutOfRangeWarning
from wheretolook.utils.shipped import WEIGHTS, or_shipped

_LOST = {
    ("sift", "aliked"): "Of 100 best views by ALIKED they lose 15, weights learnt by ALIKED 10, bins 33",
    ("sift", "disk"): "Of 100 best views by DISK they lose 19, weights learnt by ALIKED 14, bins 35",
    ("sift", "xfeat"): "Of 100 best views by XFeat they lose 17, weights learnt by ALIKED 18, bins 30",
    ("aliked", "sift"): "Of 100 best views by SIFT they lose 9, weights learnt by SIFT 7, bins 14",
    ("aliked", "disk"): "Of 100 best views by DISK they lose 14, weights learnt by SIFT 19, bins 35",
    ("aliked", "xfeat"): "Of 100 best views by XFeat they lose 18, weights learnt by SIFT 17, bins 30",
}
"""What the default scorer costs that has learnt from the first features, on maps by the second, as measured
(docs/features.md)."""


SUBSTITUTES = {"disk": "aliked", "xfeat": "aliked", "superpoint": "aliked"}
"""Features whose weights choose better than those by SIFT where a map's own have none: so on the val scenes by DISK and
XFeat (docs/features.md). SuperPoint, learned as these are, was not measured."""


def warn_of_features(of_map: str, weights: Path, stacklevel: int) -> None:
    """Warn if the landmarks of a map are of other features than weights have learnt from."""
    from wheretolook.training.weights import features_of_weights

    learnt = features_of_weights(weights)
    if not of_map or of_map in learnt:
        return
    text = f"the weights {weights.name} have learnt from maps by {', '.join(learnt)}, and this one is by {of_map}"
    lost = _LOST.get((learnt[0], of_map), "") if len(learnt) == 1 else ""
    fix = f"{lost or 'How much is lost is not known'} (docs/features.md); `wheretolook check` measures it on your map"
    theirs = SUBSTITUTES.get(of_map, of_map)
    if theirs not in learnt and or_shipped(f"{WEIGHTS}/{theirs}").is_dir():
        fix = f"Weights that suit it better ship, {WEIGHTS}/{theirs}: they are taken if none are named. {fix}"
    warnings.warn(f"{text}. {fix}.", OutOfRangeWarning, stacklevel=stacklevel + 1)
