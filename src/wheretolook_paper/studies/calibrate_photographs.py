"""Fit the offset of a network's log-odds on maps of photographs, and write it to its weights.

    wheretolook check --map entry-P10/sparse --fov 40 --weights set.safetensors --out checks/entry-P10    (and others)
    python -m wheretolook_paper.studies.calibrate_photographs --weights set.safetensors \\
        --checks '[checks/entry-P10, ...]'

Reads the scores and labels of the checks, made with weights without an offset. Every place counts the same. Prints the
calibration error of each place without an offset, with the one fitted to the other places, and with the fit to all,
which is written.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from scipy.optimize import minimize_scalar
from scipy.special import expit

from wheretolook.evaluation.statistics import expected_calibration_error
from wheretolook.scorers.adapted.calibration import finite_log_odds
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.weights import read_record, read_training
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import sha256, write_json

Views = tuple[np.ndarray, np.ndarray]  # log-odds and labels (B,) of the views of a place


def fitted_offset(places: Sequence[Views]) -> float:
    """Return the offset of most likelihood, with the same total weight for every place."""

    def loss(offset: float) -> float:
        return sum(float(np.mean(np.logaddexp(0, x + offset) - good * (x + offset))) for x, good in places)

    return float(minimize_scalar(loss, bounds=(-5, 5), method="bounded").x)


def main(weights: Path, checks: list[Path], write: bool = False) -> None:
    """Print the calibration error of each place; with `write`, store the offset in the weights.

    Args:
        weights: of a set network.
        checks: folders written by `wheretolook check`.
        write: replace the weights.
    """
    places = {}
    for folder in checks:
        views = pd.read_csv(folder / "views.csv")
        places[folder.name] = finite_log_odds(views["score"].to_numpy(), 1e-4), views["good"].to_numpy(bool)
    offset = round(fitted_offset(list(places.values())), 2)
    rows = []
    for name, (log_odds, good) in places.items():
        others = fitted_offset([views for other, views in places.items() if other != name])
        offsets = {"before": 0.0, "others": others, "written": offset}
        errors = {key: expected_calibration_error(expit(log_odds + add), good) for key, add in offsets.items()}
        own = fitted_offset([(log_odds, good)])
        rows.append({"place": name, "views": len(good), "good": good.mean(), "own": own, "of others": others, **errors})
    print(pd.DataFrame(rows).round(3).to_string(index=False))
    print(f"offset {offset}")
    if write:
        trained = TrainedNetwork.load(weights, SetNetwork, "set")
        if trained.photograph_offset:
            fix = "Check with weights that have none, and give these."
            raise ConfigError(
                "the weights have an offset already", path=weights, value=trained.photograph_offset, fix=fix
            )
        about = {**read_training(weights), "calibrated_on": [path.name for path in checks]}
        replace(trained, photograph_offset=offset).save(weights, about)
        record = read_record(weights) | {"about": about, "weights_sha256": sha256(weights)}
        write_json(weights.with_suffix(".json"), record)


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
