"""Measure what adaptation to a scene gains: trained on half of the labelled locations, tested on the other half.

    python -m wheretolook_paper.studies.adapt data/cameras --split val
    python -m wheretolook_paper.studies.adapt data/test-90 --split test --out adapted.csv

Prints a row for each scene and the means: regret in percentage points, AUC and calibration error of the bundled
weights, calibrated as by `wheretolook adapt` and corrected by a Gaussian process besides, and of bins.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli

from wheretolook.dataset.config import Split
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import CAMERA_ID, poses
from wheretolook.evaluation.adaptation import compare_log_odds, labelled_views
from wheretolook.scorers.adapted.calibration import calibrate
from wheretolook.scorers.registry import make_scorer
from wheretolook.utils.package import WEIGHTS, shipped
from wheretolook_paper.scorers.gp_correction import adapt


def main(
    data: Path, split: Split = "test", scenes: tuple[str, ...] = (), seed: int = 0, out: Path | None = None
) -> None:
    """Adapt the bundled weights to every scene, print and write the numbers.

    Args:
        data: a labelled dataset.
        split: which of its scenes.
        scenes: only these scenes.
        seed: which half is trained on.
        out: CSV file of the numbers.
    """
    rows = []
    for files in Dataset.load(data).split(split):
        if scenes and files.name not in scenes:
            continue
        table = files.read_table()
        scene = Scene(files, device="cpu")
        views = labelled_views(files, scene, table, shipped(WEIGHTS) / "set.safetensors")
        numbers = table[CAMERA_ID].to_numpy() if CAMERA_ID in table else np.zeros(len(table), dtype=int)
        bins = np.empty(len(table))
        for number in np.unique(numbers):
            camera = files.cameras()[number] if CAMERA_ID in table else scene.camera
            at = numbers == number
            bins[at] = make_scorer("bins", files.localization_map(camera, "cpu")).score(poses(table)[at])
        locations = np.random.default_rng(seed).permutation(np.unique(views.group))
        training = np.isin(views.group, locations[: len(locations) // 2])
        start = time.monotonic()
        rest = views.rows(~training)
        scale, offset = calibrate(views.rows(training))
        corrected = adapt(views.rows(training))
        judged = rest.good, rest.group, rest.centers
        calibrated = compare_log_odds(rest.log_odds, scale * rest.log_odds + offset, *judged).after
        gain = compare_log_odds(rest.log_odds, corrected.adaptation.log_odds(rest), *judged)
        by_bins = compare_log_odds(rest.log_odds, bins[~training], *judged).after
        row = {"scene": files.name, "views": int(training.sum())}
        row |= {"regret_bins": by_bins["regret"], "auc_bins": by_bins["auc"]}
        row |= {f"{name}_set": value for name, value in gain.before.items()}
        row |= {f"{name}_calibrated": value for name, value in calibrated.items()}
        row |= {f"{name}_process": value for name, value in gain.after.items()}
        row |= dict(zip(("regret_less", "regret_low", "regret_high"), gain.regret_less, strict=True))
        row |= {"length_m": corrected.length_m, "amplitude": corrected.amplitude, "seconds": time.monotonic() - start}
        rows.append(row)
        print(pd.Series(row).to_frame().T.round(3).to_string(header=len(rows) == 1), flush=True)
    found = pd.DataFrame(rows)
    print(found.mean(numeric_only=True).round(3).to_string())
    if out is not None:
        found.to_csv(out, index=False)


if __name__ == "__main__":
    auto_cli(main)
