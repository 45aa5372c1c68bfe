"""The evaluate stage on a tiny dataset whose labels follow a known rule."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from synthetic_dataset import make_dataset
from wheretolook.dataset import Dataset
from wheretolook.errors import ConfigError, TableError, WeightsError
from wheretolook.evaluation import EvaluateConfig, evaluate, latest_scores
from wheretolook.learning.config import TrainConfig
from wheretolook.learning.training import train
from wheretolook.table import UNLABELLED, is_good, write_table
from wheretolook.tracking import TrackingConfig, client, newest_run, ui_command

CONFIG = EvaluateConfig(resamples=100, top_n=(1, 5))
RULES = replace(CONFIG, methods=("random", "visible", "bins"))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    splits = ("train", "train", "test", "test")
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny", splits, n_locations=14, n_directions=16)  # type: ignore[arg-type]


def test_evaluation_writes_prints_and_logs(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cwd = tmp_path / "cwd"
    cwd.mkdir()
    monkeypatch.chdir(cwd)
    tracking = TrackingConfig(str(tmp_path / "mlruns"), "tiny")
    models = train(dataset, TrainConfig(("2d", "2d+z"), epochs=2, hidden=(16,), accelerator="cpu"), tracking, False)
    table = evaluate(dataset, CONFIG, tracking, models=models, progress=True)
    assert {*table["occlusion"]} == {"mesh"}
    methods = {("random", ""), ("visible", ""), ("bins", ""), ("mlp", "2d"), ("mlp", "2d+z"), ("oracle", "")}
    assert {*zip(table["method"], table["inputs"], strict=True)} == methods
    assert {*table["scene"]} == {"all", "scene-2", "scene-3"}
    assert len(table) == 6 * 2 * 3

    pooled = table[table["scene"] == "all"].set_index(["method", "inputs", "top_n"])
    labels = pd.concat([scene.read_table() for scene in dataset.split("test")])
    assert pooled.loc[("random", "", 1)]["raw_0.05m_0.4deg"] == pytest.approx(is_good(labels).mean())
    # labels follow the number of filled bins, scene by scene
    assert table[(table["method"] == "bins") & (table["scene"] != "all")]["roc_auc"].min() == pytest.approx(1)
    assert pooled.loc[("bins", "", 1)]["normalized_0.05m_0.4deg"] == 1
    shares = [name for name in table.columns if name.startswith(("raw", "normalized", "any"))]
    assert ((table[shares] >= 0) & (table[shares] <= 1)).all(axis=None)
    for key in ("0.05m_0.4deg", "5m_10deg"):
        low, share, high = (table[f"raw_{name}{key}"] for name in ("low_", "", "high_"))
        assert ((low <= share + 1e-9) & (share <= high + 1e-9)).all()

    results = dataset.root / "results"
    assert {path.name for path in results.iterdir()} == {"scores.csv", "scores.md", "scores.png"}
    report = (results / "scores.md").read_text()
    assert report in capsys.readouterr().out
    assert "| reprojections with bins | 100.0" in report
    assert "| MLP, 2d + z " in report

    parent = newest_run(tracking, "evaluate", {"dataset": "tiny"})
    assert parent is not None
    parent_id = parent.info.run_id
    runs = client(tracking).search_runs([parent.info.experiment_id], f"tags.mlflow.parentRunId = '{parent_id}'")
    assert len(runs) == 6 * 2
    names = {(run.data.params["method"], run.data.params["inputs"], run.data.params["top_n"]) for run in runs}
    assert names == {(*method, n) for method in methods for n in ("1", "5")}
    for run in runs:
        params = run.data.params
        row = pooled.loc[(params["method"], params["inputs"], int(params["top_n"]))]
        assert run.info.status == "FINISHED"
        assert run.data.metrics["raw_0.25m_2deg"] == pytest.approx(row["raw_0.25m_2deg"])
        assert run.data.metrics["average_precision"] == pytest.approx(row["average_precision"])
    artifacts = Path(parent.info.artifact_uri)
    assert {path.name for path in artifacts.iterdir()} == {"scores.csv", "scores.md", "scores.png"}
    assert not list(cwd.iterdir())

    pd.testing.assert_frame_equal(latest_scores(tracking), table)
    moved = TrackingConfig(str(tmp_path / "elsewhere"), "tiny")
    shutil.move(tmp_path / "mlruns", tmp_path / "elsewhere")
    pd.testing.assert_frame_equal(latest_scores(moved, "tiny"), table)
    assert latest_scores(moved, "another") is None
    store = tmp_path / "elsewhere" / "mlflow.db"
    assert ui_command(moved).endswith(f"mlflow ui --backend-store-uri sqlite:///{store}")


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


def test_bad_input_is_named(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    with pytest.raises(TableError, match="no val scene"):
        evaluate(dataset, replace(CONFIG, split="val"), tracking, progress=False)
    with pytest.raises(WeightsError, match="there are no weights"):
        evaluate(dataset, CONFIG, tracking, models=[tmp_path / "none.safetensors"], progress=False)
    with pytest.raises(ConfigError, match="methods"):
        EvaluateConfig(methods=("psychic",))
    with pytest.raises(ConfigError, match="top_n"):
        EvaluateConfig(top_n=(0,))
    untrained = make_dataset(tmp_path / "untrained", ("test",), n_locations=2, n_directions=4)
    with pytest.raises(WeightsError, match="leave mlp out"):
        evaluate(untrained, CONFIG, tracking, progress=False)
    scene = untrained.scenes[0]
    write_table(scene.read_table().assign(status=UNLABELLED), scene.table)
    with pytest.raises(TableError, match=r"scene-0.*viewpoints without labels"):
        evaluate(untrained, RULES, tracking, progress=False)
    assert not (untrained.root / "results").exists()
    assert latest_scores(tracking) is None
