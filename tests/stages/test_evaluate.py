"""The evaluate stage on a tiny dataset whose labels follow a known rule."""

import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit, logit

from learning_options import train_config
from synthetic_dataset import make_dataset
from wheretolook.commands.evaluate import evaluate_methods as evaluate
from wheretolook.commands.train import train_methods as train
from wheretolook.dataset.viewpoint_files import write_table
from wheretolook.dataset.viewpoint_table import LABELS, NO_POSE, UNLABELLED, is_good, poses
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.results import latest_scores
from wheretolook.scorers.weights import load_scorer
from wheretolook.tracking import TrackingConfig, artifact, client, finished_runs, newest_run, start_run
from wheretolook.utils.errors import ConfigError, TableError, WeightsError

pytestmark = pytest.mark.usefixtures("no_pictures")

CONFIG = EvaluateConfig(("random", "visible", "bins", "mlp"), resamples=100, top_n=(1, 5))
TWO = train_config("mlp-2d", "mlp-2d+z", epochs=2, hidden=(16,), accelerator="cpu")
RULES = replace(CONFIG, methods=("random", "visible", "bins"))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    splits = ("train", "train", "test", "test", "val")
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny", splits, n_locations=14, n_directions=16)


def logged_runs(tracking):
    """Return the newest evaluation's run, and the runs of its methods."""
    parent = newest_run(tracking, "evaluate").info
    found = client(tracking).search_runs([parent.experiment_id], f"tags.mlflow.parentRunId = '{parent.run_id}'")
    return parent, {run.data.params["method"]: run for run in found}


def test_evaluation_writes_prints_and_logs(dataset, tmp_path, capsys):
    tracking = TrackingConfig(str(tmp_path / "mlruns"), "tiny")
    models = train(dataset, TWO, tracking, False)
    table = evaluate(dataset, CONFIG, tracking, models=models, progress=True)
    methods = {"random", "visible", "bins", "mlp-2d", "mlp-2d+z", "oracle"}
    assert {*table["method"]} == methods and {*table["scene"]} == {"all", "scene-2", "scene-3"}
    assert len(table) == 6 * 2 * 3

    pooled = table[table["scene"] == "all"].set_index(["method", "top_n"])
    labels = pd.concat([scene.read_table() for scene in dataset.split("test")])
    assert pooled.loc[("random", 1)]["raw_0.05m_0.4deg"] == pytest.approx(is_good(labels).mean())
    # labels follow the number of filled bins, scene by scene
    assert table[(table["method"] == "bins") & (table["scene"] != "all")]["roc_auc"].min() == pytest.approx(1)
    assert pooled.loc[("bins", 1)]["normalized_0.05m_0.4deg"] == 1
    low, share, high = (table[f"raw_{end}5m_10deg"] for end in ("low_", "", "high_"))
    assert ((low <= share + 1e-9) & (share <= high + 1e-9)).all()
    results = dataset.root / "results"
    report = (results / "scores.md").read_text()
    assert report in capsys.readouterr().out and "| reprojections with bins | 100.0" in report

    parent, runs = logged_runs(tracking)
    assert runs.keys() == methods
    for method, n in product(methods, (1, 5)):
        row = pooled.loc[(method, n)]
        chosen = pd.read_parquet(Path(runs[method].info.artifact_uri) / "locations.parquet").query(f"top_n == {n}")
        assert len(chosen) == row["n_locations"] == 2 * 14 and not chosen.duplicated(["scene", "location_id"]).any()
        assert chosen["chosen"].sum() == row["n_views"]
        assert chosen["good_5m_10deg"].sum() == pytest.approx(row["good_5m_10deg"])
        for name in ("raw_0.25m_2deg", "regret_low_0.05m_0.4deg", "any_5m_10deg"):
            assert runs[method].data.metrics[f"top-{n}/{name}"] == pytest.approx(row[name])
    assert {path.name for path in Path(parent.artifact_uri).iterdir()} == {path.name for path in results.iterdir()}

    moved = TrackingConfig(str(tmp_path / "elsewhere"), "tiny")
    shutil.move(tmp_path / "mlruns", tmp_path / "elsewhere")
    pd.testing.assert_frame_equal(latest_scores(moved, "tiny"), table)
    assert latest_scores(moved, "another") is None
    with start_run(moved, "later", "evaluate", {"dataset": "tiny"}) as (mlflow, later):
        mlflow.log_text(later, "here", "note.txt")
    assert artifact(moved, later, "note.txt").read_text() == "here" and not (tmp_path / "mlruns").exists()
    assert [run.info.run_id for run in finished_runs(moved, "evaluate")] == [later, parent.run_id]


def test_both_localizers_are_reported(tmp_path):
    """By the first RANSAC result the same views localize, but none at a location with an odd number."""
    tracking = TrackingConfig(str(tmp_path / "mlruns"), "both")
    dataset = make_dataset(tmp_path / "both", ("test", "test"), n_locations=10, n_directions=12)
    report = dataset.root / "results" / "scores.md"
    tables = [scene.read_table() for scene in dataset.scenes]
    before = evaluate(dataset, RULES, tracking, progress=False)
    for table, scene in zip(tables, dataset.scenes, strict=True):
        assert "Both localizers" not in report.read_text()  # not while one scene has no labels by the first result
        first = {f"first_{name}": table[name] for name in LABELS}
        first["first_status"] = table["status"].where(table["location_id"] % 2 == 0, NO_POSE)
        write_table(table.assign(**first), scene.table)
        after = evaluate(dataset, RULES, tracking, progress=False)
        pd.testing.assert_frame_equal(after[[*before]], before)

    found = [table.assign(good=is_good(table)).groupby("location_id")["good"].any() for table in tables]
    share, first_share = (np.mean([one.to_numpy()[::step].sum() / len(one) for one in found]) for step in (1, 2))
    (row,) = after.query("method == 'bins' and top_n == 1 and scene == 'all'").to_dict("records")
    assert (row["raw_0.05m_0.4deg"], row["first_raw_0.05m_0.4deg"]) == pytest.approx((share, first_share))
    assert 0 < first_share < share and row["first_normalized_0.05m_0.4deg"] == 1
    section = report.read_text().split("## Both localizers")[1].split("##")[0]
    (line,) = (line for line in section.splitlines() if line.startswith("| reprojections with bins |"))
    for cell, value in zip(line.split("|")[2:4], (share, first_share), strict=True):
        assert cell.split()[0] == f"{100 * value:.1f}"
    _, runs = logged_runs(tracking)
    assert runs["bins"].data.metrics["top-1/first_raw_0.05m_0.4deg"] == pytest.approx(first_share)


def test_learned_methods_are_calibrated_on_the_val_scenes(dataset, tmp_path):
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    (model,) = train(dataset, train_config("mlp-2d+z", epochs=2, hidden=(16,), accelerator="cpu"), tracking, False)
    config = replace(CONFIG, methods=("bins", "mlp"))
    table = evaluate(dataset, config, tracking, models=[model], progress=False)
    curves = pd.read_csv(dataset.root / "results" / "calibration.csv")
    rows = table[table["method"] == "mlp-2d+z"]
    temperature = rows["temperature"].iloc[0]
    assert table.loc[table["method"] != "mlp-2d+z", ["ece", "ece_scaled", "temperature"]].isna().all(axis=None)
    (scene,) = dataset.split("val")
    views = scene.read_table()
    logits = logit(load_scorer(scene.localization_map(dataset.camera), model.path).score(poses(views)))
    assert abs(np.mean((expit(logits / temperature) - is_good(views)) * logits)) < 1e-4  # the likelihood is greatest
    assert set(curves["n_val"]) == {14 * 16}
    assert curves.groupby("when")["n"].sum().tolist() == [2 * 14 * 16] * 2
    pooled = rows[rows["scene"] == "all"].iloc[0]
    assert pooled["ece"] == pytest.approx(curves.loc[curves["when"] == "before", "ece"].iloc[0])
    assert pooled["ece_scaled"] == pytest.approx(curves.loc[curves["when"] == "after", "ece"].iloc[0])

    # the evaluated scenes do not fit their own temperature
    table = evaluate(dataset, replace(config, split="val"), tracking, models=[model], progress=False)
    rows = table[table["method"] == "mlp-2d+z"]
    assert rows["ece"].notna().all() and rows[["ece_scaled", "temperature"]].isna().all(axis=None)
    results = dataset.root / "results"
    assert {*pd.read_csv(results / "val" / "calibration.csv")["when"]} == {"before"}
    assert {*pd.read_csv(results / "calibration.csv")["when"]} == {"before", "after"}
    shutil.rmtree(results / "val")
    evaluate(dataset, replace(config, methods=("bins",)), tracking, progress=False)
    assert not (results / "calibration.csv").exists()


def test_candidates_are_chosen_by_visibility(tmp_path):
    dataset = make_dataset(tmp_path / "ranked", ("test", "test"), n_locations=14, n_directions=16)
    rng = np.random.default_rng(0)
    tables = []
    for scene in dataset.scenes:
        table = scene.read_table()
        rank = np.concatenate([rng.permutation(16) for _ in range(14)])  # so that good and bad ones are among the first
        table["visibility_rank"] = rank + 100 * (table["location_id"] == 3)  # there none of the best was labelled
        write_table(table, scene.table)
        tables.append(table.assign(scene=scene.name, good=is_good(table)))
    views = pd.concat(tables)
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    config = replace(RULES, candidates=(0, 4))
    table = evaluate(dataset, config, tracking, progress=False)
    assert list(table["candidates"].unique()) == ["all", "best 4"]

    table = table[(table["candidates"] == "best 4") & (table["scene"] == "all")].set_index(["method", "top_n"])
    best = views[views["visibility_rank"] < 4]
    random = table.loc[("random", 1)]
    assert len(best) == 2 * 13 * 4 and random["n_locations"] == random["n_views"] == 2 * 13
    assert random["raw_0.05m_0.4deg"] == pytest.approx(best["good"].mean())
    everything = table.loc[("visible", 5)]  # five of four are all of them
    assert (everything["n_views"], everything["good_0.05m_0.4deg"]) == (len(best), best["good"].sum())
    first = best.sort_values(["n_visible", "viewpoint_id"], ascending=[False, True]).groupby(["scene", "location_id"])
    assert table.loc[("visible", 1), "good_0.05m_0.4deg"] == first["good"].first().sum()

    for scene, table in zip(dataset.scenes, tables, strict=True):
        bad_first = table.sort_values("good").groupby("location_id").cumcount() + 100 * (table["location_id"] == 3)
        write_table(table.assign(visibility_rank=bad_first), scene.table)
    with pytest.raises(TableError):
        evaluate(dataset, replace(config, candidates=(0, 1)), tracking, progress=False)


def test_the_same_evaluation_is_logged_once(dataset, tmp_path):
    tracking = TrackingConfig(str(tmp_path / "mlruns"))

    def evaluate_again(config=RULES):
        evaluate(dataset, config, tracking, progress=False)
        return [run.info.run_id for run in finished_runs(tracking, "evaluate")]

    (first,) = evaluate_again()
    csv = (dataset.root / "results" / "scores.csv").read_bytes()
    scene = dataset.split("test")[0]
    table = scene.read_table()
    assert evaluate_again() == [first]
    evaluate_again(replace(RULES, seed=RULES.seed + 1))
    runs = evaluate_again()  # logged again: the newest run describes the files in the folder
    assert len(runs) == 3 and runs[-1] == first
    try:
        write_table(table.sample(frac=1, random_state=0), scene.table)  # rows are joined by id, never by order
        evaluate_again()
        assert (dataset.root / "results" / "scores.csv").read_bytes() == csv
        n_runs = len(list(finished_runs(tracking, "evaluate")))
        write_table(table.iloc[: -len(table) // 4], scene.table)
        assert len(evaluate_again()) == n_runs + 1
    finally:
        write_table(table, scene.table)


@pytest.mark.parametrize(
    "options",
    [
        {"methods": ("psychic",)}, {"top_n": (0,)}, {"candidates": ()}, {"candidates": (100, 100)}, {"seed": -1},
        {"thresholds": ((0.05, float("nan")),)}, {"thresholds": ((0.05, 0.4), (0.05, 0.4))}, {"block_m": -1.0},
        {"heading": ((0.0, 0, 0),)},
    ],
)  # fmt: skip
def test_invalid_options(options):
    with pytest.raises(ConfigError):
        EvaluateConfig(**options)


def test_invalid_input(dataset, tmp_path):
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    untrained = make_dataset(tmp_path / "untrained", ("test",), n_locations=2, n_directions=4)
    unlabelled = make_dataset(tmp_path / "unlabelled", ("test",), n_locations=2, n_directions=4)
    scene = unlabelled.scenes[0]
    write_table(scene.read_table().assign(status=UNLABELLED), scene.table)
    for data, config, error in (
        (untrained, replace(RULES, split="val"), TableError),
        (untrained, CONFIG, WeightsError),
        (untrained, replace(CONFIG, weights=(tmp_path / "none.safetensors",)), WeightsError),
        (untrained, replace(RULES, reference="mlp-2d"), ConfigError),
        (unlabelled, RULES, TableError),
    ):
        with pytest.raises(error):
            evaluate(data, config, tracking, progress=False)
        assert not (data.root / "results").exists()
