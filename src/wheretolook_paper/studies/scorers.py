"""Compare learners on validation scenes: seeds, ablations and learning curves.

    python -m wheretolook_paper.studies.scorers seeds --data data --dataset release --out study
    python -m wheretolook_paper.studies.scorers attributes ...   the set network without each landmark attribute
    python -m wheretolook_paper.studies.scorers options ...      the set network with other options
    python -m wheretolook_paper.studies.scorers curves ...       with fewer training scenes and viewpoints

Options are chosen by the mean validation average precision over seeds; the learner with the best mean ships, trained
by the train stage with the best seed. Test scenes are scored once, with the weights of every seed.

Appends a row per training to `<out>/<part>.csv` and skips existing rows. Weights are in `<out>/<method>-<seed>/weights`
and `<out>/<part>/<condition>-<seed>.safetensors`. `--set '{"pooled": 8}'` changes the network that attributes, options
and curves start from; `--choices '[{"head": 96}, ...]'` are the options to try.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from wheretolook.commands.train import train_methods as train
from wheretolook.dataset.layout import Dataset
from wheretolook.inputs.landmark_features import ATTRIBUTES
from wheretolook.scorers.mlp.config import MlpConfig
from wheretolook.scorers.set.config import SetConfig
from wheretolook.scorers.set.learn import SetDataModule, learn_set
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import start_run
from wheretolook.training.fit import RunLog
from wheretolook.training.learner import TrainingJob
from wheretolook.training.provenance import weights_path
from wheretolook.training.scenes import with_also

METHODS = ("mlp-2d+z", "mlp-2d+3d+landmark", "conv", "trees", "set", "sphere")

OF_NETWORKS = MlpConfig(epochs=100, batch_size=4096, noise_px=1.0, noise_m=0.02, balance=True)
"""Options of the paper's network: those of configs/release.yaml with a third of the epochs."""


CHOICES: list[dict[str, Any]] = [
    {}, {"pooled": 0}, {"pooled": 16}, {"width": 96}, {"width": 24}, {"head": 96}, {"dropout": 0.3}, {"l2": 1e-4},
    {"learning_rate": 1e-3}, {"epochs": 16}, {"from_matchability": False}, {"landmarks": 96}, {"enlarged": 1.0},
]  # fmt: skip
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


def seeds(dataset: Dataset, args: argparse.Namespace, tracking: TrackingConfig) -> None:
    """Train every learner with every seed."""
    table = args.out / "seeds.csv"
    for seed in args.seeds:
        for method in args.methods:
            if has_row(table, method=method, seed=seed):
                continue
            own = Dataset(args.out / f"{method}-{seed}", dataset.scenes)
            start = weights_path(dataset, "matchability")
            if start.is_file():
                (own.root / "weights").mkdir(parents=True, exist_ok=True)
                shutil.copyfile(start, own.root / "weights" / start.name)
            config = TrainConfig(methods=(method,), seed=seed, mlp=OF_NETWORKS)
            (model,) = train(own, config, tracking, progress=args.progress)
            add_row(table, {"method": method, "seed": seed}, model.metrics)


def of_set_network(dataset: Dataset, args: argparse.Namespace, tracking: TrackingConfig) -> None:
    """Train the set network under other conditions, on views that are described once."""
    table = args.out / f"{args.part}.csv"
    log = RunLog(tracking, "")
    task = TrainingJob(dataset, "set", TrainConfig(methods=("set",)), SetConfig(), "set", args.progress, log)
    data = SetDataModule(task)
    whole = data.train_rows
    conditions: list[tuple[str, dict[str, Any], torch.Tensor]] = []
    if args.part == "attributes":
        groups = {"none": (), **{name: (name,) for name in ATTRIBUTES[3:]}, "all": ATTRIBUTES[3:]}
        conditions = [(name, {"hidden": hidden}, whole) for name, hidden in groups.items()]
    if args.part == "options":
        conditions = [(" ".join(f"{k}={v}" for k, v in one.items()) or "default", one, whole) for one in args.choices]
    if args.part == "curves":
        train_rows = whole.numpy()
        rng = np.random.default_rng(0)
        scene = data.views.scene[train_rows]
        order = rng.permutation(np.unique(scene))
        some = {f"{n} scenes": train_rows[np.isin(scene, order[:n])] for n in (1, 2, 3, 5, 7, 9) if n <= len(order)}
        for share in (0.01, 0.03, 0.1, 0.3):
            some[f"{share:g} of the views"] = np.sort(
                rng.choice(train_rows, int(share * len(train_rows)), replace=False)
            )
        conditions = [(name, {}, torch.from_numpy(chosen)) for name, chosen in some.items()]
    for seed in args.seeds:
        for name, options, rows in conditions:
            if has_row(table, condition=name, seed=seed):
                continue
            data.train_rows = rows
            settings = replace(SetConfig(**args.set), **options)
            # the same number of steps for any amount of data
            epochs = min(200, round(settings.epochs * len(whole) / len(rows)))
            config = replace(task.config, seed=seed)
            own = replace(settings, epochs=epochs)
            data.config = config
            torch.manual_seed(seed)
            about = {"condition": name, "seed": seed}
            with start_run(tracking, f"study {args.part} {name}", "train", about) as (_, run):
                result = learn_set(replace(task, config=config, options=own, run_log=RunLog(tracking, run)), data)
            file = f"{name.replace(' ', '_').replace('=', '-') or 'default'}-{seed}.safetensors"
            result.model.save(args.out / args.part / file, {"method": "set", "condition": name, "seed": seed})
            add_row(table, {**about, "views": len(rows)}, result.metrics)


def main() -> None:
    """Run one part of the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("seeds", "attributes", "options", "curves"))
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--dataset", default="release")
    parser.add_argument("--also", nargs="+", default=[], help="further datasets to train on")
    parser.add_argument("--out", type=Path, default=Path("study"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--set", type=json.loads, default={}, help="options of the set network, JSON")
    parser.add_argument("--choices", type=json.loads, default=CHOICES, help="options to try, a list of JSON objects")
    parser.add_argument("--progress", action="store_true")
    args = parser.parse_args()
    whole = with_also(Dataset.load(args.data / args.dataset), args.also)
    dataset = Dataset(whole.root, (*whole.split("train"), *whole.split("val")))
    part = seeds if args.part == "seeds" else of_set_network
    part(dataset, args, TrackingConfig(folder=str(args.out / "mlruns"), experiment="study"))


if __name__ == "__main__":
    main()
