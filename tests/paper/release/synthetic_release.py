"""A tiny release with every kind of results, made up but for its tables of viewpoints."""

import json

import pandas as pd

from synthetic_dataset import make_dataset
from synthetic_scores import make_scores
from wheretolook.dataset.config import RELEASE_FILE
from wheretolook_paper.evaluation.paper_tables import write_paper_tables

METHODS = ("random", "bins", "fisher-trace-exact", "mlp-2d+z", "mlp-2d+3d")


def make_release(root):
    """A dataset of two test scenes with results, the record of one network, and no MLflow store."""
    dataset = make_dataset(root, ("test", "test"), n_locations=4, n_directions=6)
    results = root / "results"
    weights = root / "weights"
    results.mkdir()
    weights.mkdir()
    scores = make_scores(METHODS, scenes=("scene-0", "scene-1"))
    walls = pd.concat([scores, scores.assign(occlusion="none")], ignore_index=True)
    walls.to_csv(results / "scores.csv", index=False)
    write_paper_tables(scores, results)
    others = make_scores(METHODS, scenes=("a", "b"), seed=1)
    others.assign(dataset="interiors", weights_sha256="0").to_csv(results / "generalization.csv", index=False)
    calibration().to_csv(results / "calibration.csv", index=False)
    runtimes().to_csv(results / "runtimes.csv", index=False)
    learners().to_csv(results / "learners.csv", index=False)
    paths().to_csv(results / "paths.csv", index=False)
    looks().to_csv(results / "looks.csv", index=False)
    extended().to_csv(results / "extend.csv", index=False)
    config = {"bins": 30, "hidden": [300, 300], "dropout": 0.5, "seed": 0}
    about = {"method": "mlp-2d+3d", "dataset": dataset.name, "dataset_fingerprint": "0", "config": config}
    metrics = {"epoch": 1.0, "val_average_precision": 0.75, "val_roc_auc": 0.8}
    record = {"about": about, "weights_sha256": "0", "run_id": "0" * 32, "metrics": metrics}
    (weights / "mlp-2d+3d.json").write_text(json.dumps(record))
    about = {"source": "source", "source_fingerprint": "0", "code_version": "0", "settings": {}}
    (root / RELEASE_FILE).write_text(json.dumps(about))
    return dataset


def history():
    """Three epochs; the second is the best."""
    columns = {"epoch": [0, 1, 2], "train_bce": [0.6, 0.5, 0.4], "val_bce": [0.7, 0.6, 0.65]}
    precision = {"train_average_precision": [0.5, 0.7, 0.9], "val_average_precision": [0.5, 0.75, 0.7]}
    return pd.DataFrame({**columns, **precision})


def calibration():
    bins = {"bin_low": [0.0, 0.5], "bin_high": [0.5, 1.0], "mean_predicted": [0.2, 0.8], "share_good": [0.1, 0.9]}
    about = {"method": "mlp-2d+z", "temperature": 1.2, "n_val": 10, "n_views": 30, "when": "before"}
    return pd.DataFrame({**bins, "n": [10, 20], "ece": 0.1, "nll": 0.3}).assign(**about)


def extended():
    """Two maps of ten views each, of which photographs in pairs localize three and lose one more."""
    localized = {"none": "x.........", "pairs": ".xxx......", "random": "x........."}
    rows = [
        {"scene": "a", "seed": seed, "policy": policy, "views": 10, "strict": marks.count("x") / 10, "coarse": 0.5,
         "localized": marks, "p_registers": "0.900 0.200" if policy == "pairs" else None,
         "registered": "x." if policy == "pairs" else None}
        for seed in (0, 1) for policy, marks in localized.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


def looks():
    rows = [("together", 1, 0.7, 0.7), ("together", 2, 0.8, 0.75), ("random", 2, 0.5, None)]
    table = pd.DataFrame(rows, columns=["strategy", "n_looks", "good", "any_good"]).assign(n_locations=8)
    return pd.concat([table.assign(split=split) for split in ("val", "test")])


def runtimes():
    about = {
        "locations": 648,
        "directions": 500,
        "landmarks": 24919,
        "device": "cpu",
        "name": "A Processor",
        "cores": 2,
    }
    rows = [
        {
            "what": what,
            "threads": 1,
            "median_s": 2.0,
            "min_s": 1.5,
            "max_s": 3.0,
            "repeats": 5,
            "projections_per_s": 4e9,
        }
        for what in ("counts alone", "occlusion, counts, best 100", "NumPy twin, counts alone, scaled")
    ]
    return pd.DataFrame(rows).assign(**about)


def learners():
    rows = [
        {"learner": learner, "trained_on": source, "seed": seed, "split": split, "scene": scene,
         "average_precision": 0.8 + seed / 10, "roc_auc": 0.9, "ece": 0.1, "regret": regret}
        for learner, source, seed in (("bins", "", 0), ("set", "apartments", 0), ("set", "apartments", 1))
        for split, scene, regret in (("test", "a", 0.1), ("test", "b", 0.3), ("others", "c", 0.2))
    ]  # fmt: skip
    return pd.DataFrame(rows)


def paths():
    columns = ("pairs", "failures", "views", "localized", "localized_low", "localized_high", "times_forward",
               "times_forward_low", "times_forward_high", "times_forward_length", "length_m", "turn_deg_per_m",
               "promised")  # fmt: skip
    rows = [
        {"scene": scene, "task": task, "method": method, **dict.fromkeys(columns, 0.5)}
        for scene in ("scene-0", "all")
        for task in ("planned", "given")
        for method in ("forward", "bins")
    ]
    return pd.DataFrame(rows)
