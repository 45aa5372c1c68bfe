"""The evaluate stage on a tiny dataset whose labels follow a known rule."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.special import expit, logit

from learning_options import train_config
from synthetic_dataset import make_dataset
from wheretolook.commands.evaluate import evaluate_methods as evaluate
from wheretolook.commands.train import train_methods as train
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses, write_table
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.results import latest_scores
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import artifact, experiment_ids, finished_runs, newest_run, start_run, ui_command
from wheretolook.tracking.store import client
from wheretolook.utils.errors import ConfigError, TableError, WeightsError
from wheretolook.weights.resolve import load_scorer

pytestmark = pytest.mark.usefixtures("no_pictures")

CONFIG = EvaluateConfig(("random", "visible", "bins", "mlp"), resamples=100, top_n=(1, 5))
TWO = train_config("mlp-2d", "mlp-2d+z", epochs=2, hidden=(16,), accelerator="cpu")
RULES = replace(CONFIG, methods=("random", "visible", "bins"))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    splits = ("train", "train", "test", "test", "val")
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny", splits, n_locations=14, n_directions=16)  # type: ignore[arg-type]


def test_evaluation_writes_prints_and_logs(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cwd = tmp_path / "cwd"
    cwd.mkdir()
    monkeypatch.chdir(cwd)
    tracking = TrackingConfig(str(tmp_path / "mlruns"), "tiny")
    models = train(
        dataset, train_config("mlp-2d", "mlp-2d+z", epochs=2, hidden=(16,), accelerator="cpu"), tracking, False
    )
    table = evaluate(dataset, CONFIG, tracking, models=models, progress=True)
    assert {*table["occlusion"]} == {"mesh"} and {*table["candidates"]} == {"all"}
    assert list(table)[:4] == ["method", "occlusion", "candidates", "top_n"]
    methods = {"random", "visible", "bins", "mlp-2d", "mlp-2d+z", "oracle"}
    assert {*table["method"]} == methods
    assert {*table["scene"]} == {"all", "scene-2", "scene-3"}
    assert len(table) == 6 * 2 * 3

    pooled = table[table["scene"] == "all"].set_index(["method", "top_n"])
    labels = pd.concat([scene.read_table() for scene in dataset.split("test")])
    assert pooled.loc[("random", 1)]["raw_0.05m_0.4deg"] == pytest.approx(is_good(labels).mean())
    # labels follow the number of filled bins, scene by scene
    assert table[(table["method"] == "bins") & (table["scene"] != "all")]["roc_auc"].min() == pytest.approx(1)
    assert pooled.loc[("bins", 1)]["normalized_0.05m_0.4deg"] == 1
    shares = [name for name in table.columns if name.startswith(("raw", "normalized", "any"))]
    assert ((table[shares] >= 0) & (table[shares] <= 1)).all(axis=None)
    for key in ("0.05m_0.4deg", "5m_10deg"):
        low, share, high = (table[f"raw_{name}{key}"] for name in ("low_", "", "high_"))
        assert ((low <= share + 1e-9) & (share <= high + 1e-9)).all()

    results = dataset.root / "results"
    figures = {"scores.png", "regret.png", "calibration.png"}
    tables = {f"table_{name}.{kind}" for name in ("vs_others", "input_variants") for kind in ("csv", "md", "tex")}
    expected = {"scores.csv", "scores.md", "calibration.csv"} | figures | tables
    assert {path.name for path in results.iterdir()} == {*expected, "comparisons.md"}
    report = (results / "scores.md").read_text()
    assert report in capsys.readouterr().out
    assert "| reprojections with bins | 100.0" in report
    assert "| MLP, 2d + z " in report

    parent = newest_run(tracking, "evaluate", {"dataset": "tiny"})
    assert parent is not None
    parent_id = parent.info.run_id
    runs = client(tracking).search_runs([parent.info.experiment_id], f"tags.mlflow.parentRunId = '{parent_id}'")
    assert {run.data.params["method"] for run in runs} == {*methods}
    assert len(runs) == 6
    for run, n in ((run, n) for run in runs for n in (1, 5)):
        params = run.data.params
        metrics = run.data.metrics
        row = pooled.loc[(params["method"], n)]
        assert run.info.status == "FINISHED"
        assert metrics[f"top-{n}/raw_0.25m_2deg"] == pytest.approx(row["raw_0.25m_2deg"])
        assert metrics["average_precision"] == pytest.approx(row["average_precision"])
        chosen = pd.read_parquet(Path(run.info.artifact_uri) / "locations.parquet").query(f"top_n == {n}")
        assert len(chosen) == row["n_locations"] == 2 * 14 and not chosen.duplicated(["scene", "location_id"]).any()
        assert chosen["chosen"].sum() == row["n_views"]
        for key in ("0.05m_0.4deg", "5m_10deg"):
            assert chosen[f"good_{key}"].sum() == pytest.approx(row[f"good_{key}"])
            assert chosen[f"any_{key}"].mean() == pytest.approx(row[f"any_{key}"])
        assert chosen["best_score"].isna().all() == (params["method"] in ("random", "oracle"))
        assert metrics["1_regret"] == pytest.approx(pooled.loc[(params["method"], 1)]["regret_0.05m_0.4deg"])
        for name in ("regret_0.25m_2deg", "regret_low_0.05m_0.4deg", "any_5m_10deg", "normalized_0.5m_5deg"):
            assert metrics[f"top-{n}/{name}"] == pytest.approx(row[name])
        assert params["candidates"] == "all"
        assert {"split", "seed", "thresholds", "weights", "reference", "dataset_fingerprint"} <= set(params)
        for scene in ("scene-2", "scene-3"):
            (part,) = table[
                (table["method"] == params["method"]) & (table["top_n"] == n) & (table["scene"] == scene)
            ].to_dict("records")  # fmt: skip
            assert metrics[f"top-{n}/{scene}/regret_0.05m_0.4deg"] == pytest.approx(part["regret_0.05m_0.4deg"])
    artifacts = Path(parent.info.artifact_uri)
    assert {path.name for path in artifacts.iterdir()} == {path.name for path in results.iterdir()}
    assert not list(cwd.iterdir())

    pd.testing.assert_frame_equal(latest_scores(tracking), table)
    moved = TrackingConfig(str(tmp_path / "elsewhere"), "tiny")
    shutil.move(tmp_path / "mlruns", tmp_path / "elsewhere")
    pd.testing.assert_frame_equal(latest_scores(moved, "tiny"), table)
    assert latest_scores(moved, "another") is None
    store = tmp_path / "elsewhere" / "mlflow.db"
    assert ui_command(moved).endswith(f"mlflow ui --backend-store-uri sqlite:///{store}")
    with start_run(moved, "later", "evaluate", {"dataset": "tiny"}) as (mlflow, later):
        mlflow.log_text(later, "here", "note.txt")
    assert artifact(moved, later, "note.txt").read_text() == "here" and not (tmp_path / "mlruns").exists()
    assert [run.info.run_id for run in finished_runs(moved, "evaluate")] == [later, parent_id]
    assert len(experiment_ids(client(moved), moved)) == 2  # MLflow keeps the old place in the old one


def test_learned_methods_are_calibrated_on_the_val_scenes(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    (model,) = train(dataset, train_config("mlp-2d+z", epochs=2, hidden=(16,), accelerator="cpu"), tracking, False)
    config = replace(CONFIG, methods=("bins", "mlp"))
    table = evaluate(dataset, config, tracking, models=[model], progress=False)
    curves = pd.read_csv(dataset.root / "results" / "calibration.csv")

    def predicted(split: str) -> tuple[np.ndarray, np.ndarray]:
        parts = []
        for scene in dataset.split(split):  # type: ignore[arg-type]
            views = scene.read_table()
            scorer = load_scorer(model.path, scene.localization_map(dataset.camera))
            parts.append((scorer.score(poses(views)), is_good(views)))
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    rows = table[table["method"] == "mlp-2d+z"]
    temperature = rows["temperature"].iloc[0]
    assert (rows["temperature"] == temperature).all()
    assert table.loc[table["method"] != "mlp-2d+z", ["ece", "ece_scaled", "temperature"]].isna().all(axis=None)
    val, good = predicted("val")
    assert abs(np.mean((expit(logit(val) / temperature) - good) * logit(val))) < 1e-4  # the likelihood is greatest
    test, good = predicted("test")
    after = expit(logit(test) / temperature)
    for when, values in (("before", test), ("after", after)):
        part = curves[curves["when"] == when]
        assert (part["n_val"].iloc[0], part["n_views"].iloc[0], part["n"].sum()) == (14 * 16, 2 * 14 * 16, 2 * 14 * 16)
        assert part["temperature"].iloc[0] == pytest.approx(temperature)
        assert (part["share_good"] * part["n"]).sum() == pytest.approx(good.sum())
        assert (part["mean_predicted"] * part["n"]).sum() == pytest.approx(values.sum())
        assert part["nll"].iloc[0] == pytest.approx(-np.log(np.where(good, values, 1 - values)).mean())
    pooled = rows[rows["scene"] == "all"].iloc[0]
    assert pooled["ece"] == pytest.approx(curves.loc[curves["when"] == "before", "ece"].iloc[0])
    assert pooled["ece_scaled"] == pytest.approx(curves.loc[curves["when"] == "after", "ece"].iloc[0])

    # those evaluated do not fit themselves
    table = evaluate(dataset, replace(config, split="val"), tracking, models=[model], progress=False)
    rows = table[table["method"] == "mlp-2d+z"]
    assert rows["ece"].notna().all() and rows[["ece_scaled", "temperature"]].isna().all(axis=None)
    results = dataset.root / "results"
    assert {*pd.read_csv(results / "val" / "calibration.csv")["when"]} == {"before"}
    assert "tiny, val scenes" in (results / "val" / "scores.md").read_text()
    assert {*pd.read_csv(results / "calibration.csv")["when"]} == {"before", "after"}  # that of the test scenes stays
    shutil.rmtree(results / "val")
    evaluate(dataset, replace(config, methods=("bins",)), tracking, progress=False)
    assert not (dataset.root / "results" / "calibration.csv").exists()
    # without labels on val scenes it is not known
    unlabelled = make_dataset(tmp_path / "unlabelled", ("val", "val", "test"), n_locations=5, n_directions=16)
    for scene in unlabelled.split("val"):
        write_table(scene.read_table().assign(status=UNLABELLED), scene.table)
    table = evaluate(unlabelled, config, tracking, models=[model], progress=False)
    assert table["temperature"].isna().all() and table.loc[table["method"] == "mlp-2d+z", "ece"].notna().all()


def test_candidates_are_chosen_by_visibility(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "ranked", ("test", "test"), n_locations=14, n_directions=16)
    tables = []
    rng = np.random.default_rng(0)
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
    alone = evaluate(dataset, RULES, tracking, progress=False)
    pd.testing.assert_frame_equal(table[table["candidates"] == "all"].reset_index(drop=True), alone)

    rows = table[table["candidates"] == "best 4"].set_index(["method", "top_n", "scene"])
    best = views[views["visibility_rank"] < 4]
    assert len(best) == 2 * 13 * 4
    random = rows.loc[("random", 1, "all")]
    assert (random["n_locations"], random["n_views"]) == (2 * 13, 2 * 13)
    assert random["raw_0.05m_0.4deg"] == pytest.approx(best["good"].mean())
    assert rows.loc[("oracle", 1, "scene-1"), "good_0.05m_0.4deg"] == (
        best[best["scene"] == "scene-1"].groupby("location_id")["good"].any().sum()
    )
    # five of four are all of them
    assert rows.loc[("visible", 5, "all"), "n_views"] == len(best)
    assert rows.loc[("visible", 5, "all"), "good_0.05m_0.4deg"] == best["good"].sum()
    first = best.sort_values(["n_visible", "viewpoint_id"], ascending=[False, True]).groupby(["scene", "location_id"])
    assert rows.loc[("visible", 1, "all"), "good_0.05m_0.4deg"] == first["good"].first().sum()

    parent = newest_run(tracking, "evaluate", {"dataset": "ranked"})
    both = client(tracking).search_runs([parent.info.experiment_id], "params.candidates = 'best 4'")  # type: ignore[union-attr]
    assert {run.info.run_name for run in both} >= {
        f"{method}, mesh, best 4 (evaluate ranked)" for method in ("visible", "oracle")
    }
    chosen = pd.read_parquet(Path(both[0].info.artifact_uri) / "locations.parquet")
    assert len(chosen) == 2 * 2 * 13 and 3 not in set(chosen["location_id"])

    with pytest.raises(TableError):
        for scene, table in zip(dataset.scenes, tables, strict=True):
            bad_first = table.sort_values("good").groupby("location_id").cumcount() + 100 * (table["location_id"] == 3)
            write_table(table.assign(visibility_rank=bad_first), scene.table)
        evaluate(dataset, replace(config, candidates=(0, 1)), tracking, progress=False)


def test_the_same_seed_gives_the_same_table(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    first = evaluate(dataset, RULES, tracking, progress=False)
    csv = (dataset.root / "results" / "scores.csv").read_bytes()
    scene = dataset.split("test")[0]
    table = scene.read_table()
    try:
        write_table(table.sample(frac=1, random_state=0), scene.table)  # rows are joined by id, never by order
        pd.testing.assert_frame_equal(evaluate(dataset, RULES, tracking, progress=False), first)
        assert (dataset.root / "results" / "scores.csv").read_bytes() == csv
    finally:
        write_table(table, scene.table)


def test_the_same_evaluation_is_logged_once(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))

    def ids() -> list[str]:
        return [run.info.run_id for run in finished_runs(tracking, "evaluate")]

    evaluate(dataset, RULES, tracking, progress=False)
    (first,) = ids()
    evaluate(dataset, RULES, tracking, progress=False)
    assert ids() == [first]
    other = replace(RULES, seed=RULES.seed + 1)
    evaluate(dataset, other, tracking, progress=False)
    evaluate(dataset, RULES, tracking, progress=False)  # again, so that the newest tells what lies in the folder
    runs = list(finished_runs(tracking, "evaluate"))
    assert len(runs) == 3 and runs[0].data.params["seed"] == str(RULES.seed) and runs[-1].info.run_id == first
    assert latest_scores(tracking, dataset.name) is not None
    artifact(tracking, runs[0].info.run_id, "scores.csv").unlink()
    evaluate(dataset, RULES, tracking, progress=False)
    assert len(ids()) == 4
    scene = dataset.split("test")[0]
    table = scene.read_table()
    try:
        write_table(table.iloc[: -len(table) // 4], scene.table)
        evaluate(dataset, RULES, tracking, progress=False)
    finally:
        write_table(table, scene.table)
    assert len(ids()) == 5


def test_bad_input_is_named(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    with pytest.raises(TableError, match="no val scene"):
        evaluate(replace(dataset, scenes=dataset.scenes[:4]), replace(CONFIG, split="val"), tracking, progress=False)
    with pytest.raises(WeightsError, match="there are no weights"):
        evaluate(dataset, CONFIG, tracking, models=[tmp_path / "none.safetensors"], progress=False)
    with pytest.raises(ConfigError, match="methods"):
        EvaluateConfig(methods=("psychic",))
    with pytest.raises(ConfigError, match="top_n"):
        EvaluateConfig(top_n=(0,))
    for candidates in ((), (-1,), (100, 100)):
        with pytest.raises(ConfigError, match="candidates"):
            EvaluateConfig(candidates=candidates)
    for wrong in (
        {"seed": -1}, {"thresholds": ((0.05, float("nan")),)}, {"thresholds": ((0.05, 0.4), (0.05, 0.4))},
        {"block_m": -1.0}, {"heading": ((0.0, 0, 0),)}, {"heading": ((1.0, 0, 0), (1.0, 0, 0))},
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            EvaluateConfig(**wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"reference.*'mlp-2d'.*random, visible, bins"):
        evaluate(dataset, replace(RULES, reference="mlp-2d"), tracking, progress=False)
    untrained = make_dataset(tmp_path / "untrained", ("test",), n_locations=2, n_directions=4)
    with pytest.raises(WeightsError, match="leave mlp out"):
        evaluate(untrained, CONFIG, tracking, progress=False)
    scene = untrained.scenes[0]
    write_table(scene.read_table().assign(status=UNLABELLED), scene.table)
    with pytest.raises(TableError, match=r"scene-0.*viewpoints without labels"):
        evaluate(untrained, RULES, tracking, progress=False)
    assert not (untrained.root / "results").exists()
    assert latest_scores(tracking) is None
