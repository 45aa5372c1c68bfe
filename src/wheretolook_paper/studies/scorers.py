"""Compare learners on validation scenes: seeds, ablations and learning curves.

    python -m wheretolook_paper.studies.scorers --dataset data/release --out study seeds
    python -m wheretolook_paper.studies.scorers ... attributes   the set network without each landmark attribute
    python -m wheretolook_paper.studies.scorers ... options      the set network with other options
    python -m wheretolook_paper.studies.scorers ... curves       with fewer training scenes and viewpoints

Options are chosen by the mean validation average precision over seeds; the learner with the best mean ships, trained
by the train stage with the best seed. Test scenes are scored once, with the weights of every seed.

Appends a row per training to `<out>/<part>.csv` and skips existing rows. Weights are in `<out>/<method>-<seed>/weights`
and `<out>/<part>/<condition>-<seed>.safetensors`. `--set '{"width": 96}'` changes the network that attributes, options
and curves start from; `--choices '[{"head": 96}, ...]'` are the options to try.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jsonargparse import auto_cli

from wheretolook.commands.train import train_methods as train
from wheretolook.dataset.layout import Dataset
from wheretolook.inputs.landmark_features import ATTRIBUTES
from wheretolook.scorers.mlp import MlpConfig
from wheretolook.scorers.set import SetConfig
from wheretolook.scorers.set.learn import SetDataModule, learn_set
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.tracking import TrackingConfig, start_run
from wheretolook.training.fit import RunLog
from wheretolook.training.learner import TrainingJob
from wheretolook.training.provenance import weights_path, with_also

METHODS = ("mlp-2d+z", "mlp-2d+3d+landmark", "conv", "trees", "set", "sphere")

OF_NETWORKS = MlpConfig(epochs=100, batch_size=4096, noise_px=1.0, noise_m=0.02, balance=True)
"""Options of the paper's network: those of configs/release.yaml with a third of the epochs."""


CHOICES: tuple[dict[str, Any], ...] = (
    {}, {"width": 96}, {"width": 24}, {"head": 96}, {"dropout": 0.3}, {"l2": 1e-4},
    {"learning_rate": 1e-3}, {"epochs": 16}, {"from_matchability": False}, {"landmarks": 96}, {"enlarged": 1.0},
)  # fmt: skip
"""Options of the set network to try."""


def has_row(path: Path, **key: Any) -> bool:
    """Return whether a CSV file has a row with these values."""
    if not path.is_file():
        return False
    table = pd.read_csv(path, keep_default_na=False, dtype=str)
    return bool((table[list(key)] == [str(value) for value in key.values()]).all(axis=1).any())


def add_row(path: Path, row: dict[str, Any], metrics: dict[str, float]) -> None:
    """Append a row with validation metrics to a CSV file and print it."""
    row |= {name: round(metrics[f"val_{name}"], 5) for name in ("average_precision", "roc_auc", "bce")}
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame([row]).to_csv(path, mode="a", index=False, header=not path.is_file())
    print(row, flush=True)


class Study:
    """Trainings with several seeds on the train scenes of a dataset.

    Args:
        dataset: folder of the dataset.
        out: folder of the tables and weights.
        also: further datasets to train on, in the same folder.
        numbers: seeds.
        set: options of the set network that its studies start from.
    """

    def __init__(
        self,
        dataset: Path = Path("data/release"),
        out: Path = Path("study"),
        also: tuple[str, ...] = (),
        numbers: tuple[int, ...] = (0, 1, 2, 3, 4),
        set: dict[str, Any] = {},  # noqa: B006
    ) -> None:
        whole = with_also(Dataset.load(dataset), also)
        self.dataset = Dataset(whole.root, (*whole.split("train"), *whole.split("val")))
        self.out = out
        self.numbers = numbers
        self.set = SetConfig(**set)
        self.tracking = TrackingConfig(folder=str(out / "mlruns"), experiment="study")

    def seeds(self, methods: tuple[str, ...] = METHODS) -> None:
        """Train every learner with every seed."""
        table = self.out / "seeds.csv"
        for seed, method in product(self.numbers, methods):
            if has_row(table, method=method, seed=seed):
                continue
            own = Dataset(self.out / f"{method}-{seed}", self.dataset.scenes)
            start = weights_path(self.dataset, "matchability")
            if start.is_file():
                (own.root / "weights").mkdir(parents=True, exist_ok=True)
                shutil.copyfile(start, own.root / "weights" / start.name)
            config = TrainConfig(methods=(method,), seed=seed, mlp=OF_NETWORKS)
            (model,) = train(own, config, self.tracking)
            add_row(table, {"method": method, "seed": seed}, model.metrics)

    def attributes(self) -> None:
        """Train the set network with no, each single and all further attributes of landmarks."""
        groups = {"none": (), **{name: (name,) for name in ATTRIBUTES[3:]}, "all": ATTRIBUTES[3:]}
        self._train_sets("attributes", [(name, {"hidden": hidden}, None) for name, hidden in groups.items()])

    def options(self, choices: tuple[dict[str, Any], ...] = CHOICES) -> None:
        """Train the set network with other options."""
        names = [" ".join(f"{k}={v}" for k, v in one.items()) or "default" for one in choices]
        self._train_sets("options", [(name, one, None) for name, one in zip(names, choices, strict=True)])

    def curves(self) -> None:
        """Train the set network with fewer scenes and with fewer views."""
        data = self._views()
        rows = data.train_rows.numpy()
        rng = np.random.default_rng(0)
        scene = data.views.scene[rows]
        order = rng.permutation(np.unique(scene))
        some = {f"{n} scenes": rows[np.isin(scene, order[:n])] for n in (1, 2, 3, 5, 7, 9) if n <= len(order)}
        for share in (0.01, 0.03, 0.1, 0.3):
            some[f"{share:g} of the views"] = np.sort(rng.choice(rows, int(share * len(rows)), replace=False))
        self._train_sets("curves", [(name, {}, torch.from_numpy(chosen)) for name, chosen in some.items()])

    def _views(self) -> SetDataModule:
        return SetDataModule(replace(self._job(), options=SetConfig()))

    def _job(self, seed: int = 0, run: str = "") -> TrainingJob:
        config = TrainConfig(methods=("set",), seed=seed)
        return TrainingJob(self.dataset, "set", config, self.set, "set", True, RunLog(self.tracking, run))

    def _train_sets(self, part: str, conditions: list[tuple[str, dict[str, Any], torch.Tensor | None]]) -> None:
        """Train the set network under conditions, a name, changed options and the views used, described once."""
        table = self.out / f"{part}.csv"
        data = self._views()
        whole = data.train_rows
        for seed, (name, changes, rows) in product(self.numbers, conditions):
            if has_row(table, condition=name, seed=seed):
                continue
            data.train_rows = whole if rows is None else rows
            # the same number of steps for any amount of data
            options = replace(self.set, **changes)
            options = replace(options, epochs=min(200, round(options.epochs * len(whole) / len(data.train_rows))))
            about = {"condition": name, "seed": seed}
            with start_run(self.tracking, f"study {part} {name}", "train", about) as (_, run):
                job = replace(self._job(seed, run), options=options)
                data.config = job.config
                torch.manual_seed(seed)
                result = learn_set(job, data)
            file = f"{name.replace(' ', '_').replace('=', '-')}-{seed}.safetensors"
            result.model.save(self.out / part / file, {"method": "set", **about})
            add_row(table, {**about, "views": len(data.train_rows)}, result.metrics)


if __name__ == "__main__":
    auto_cli(Study, as_positional=False)
