"""A release logged as MLflow runs: once, as the stages log, and open to every search that the page on runs names."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pandas as pd
import pytest

from synthetic_dataset import make_dataset
from synthetic_release import METHODS, history, make_release
from wheretolook.dataset.folders import Dataset
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.results import latest_scores
from wheretolook.evaluation.scores import read_scores
from wheretolook.learning.runs import HISTORY_CSV, histories, keep_histories, trained
from wheretolook.release.notebook import open_store
from wheretolook.release.runs import ReleaseRuns, log_release
from wheretolook.stages.evaluate import evaluate_methods as evaluate
from wheretolook.utils.errors import MissingRunError
from wheretolook.utils.tracking import client, experiment_ids, finished_runs, newest_artifact, newest_run
from wheretolook.utils.tracking_config import TrackingConfig

PAGE = Path(__file__).parents[2] / "mlruns" / "README.md"


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, TrackingConfig, ReleaseRuns]:
    folder = tmp_path_factory.mktemp("logged")
    release, tracking = make_release(folder / "data" / "release"), TrackingConfig(str(folder / "mlruns"))
    return release, tracking, log_release(release, tracking)


@pytest.fixture
def store(logged: tuple[Dataset, TrackingConfig, ReleaseRuns], tmp_path: Path) -> tuple[Dataset, TrackingConfig]:
    """A release and its store that may be changed."""
    shutil.copytree(logged[0].root.parent.parent, tmp_path / "copy")
    release = Dataset.load(tmp_path / "copy" / "data" / "release")
    return release, TrackingConfig(str(tmp_path / "copy" / "mlruns"))


def children(tracking: TrackingConfig, parent: str) -> dict[str, tuple[dict[str, str], dict[str, float]]]:
    """Parameters and metrics of the runs nested in a run, by their names."""
    experiment = client(tracking).get_run(parent).info.experiment_id
    query = f"tags.mlflow.parentRunId = '{parent}'"
    runs = client(tracking).search_runs([experiment], query, max_results=1000)
    assert {run.info.status for run in runs} <= {"FINISHED"}
    return {run.info.run_name: (run.data.params, run.data.metrics) for run in runs}


def test_every_kind_of_result_becomes_a_run_once(logged: tuple[Dataset, TrackingConfig, ReleaseRuns]) -> None:
    release, tracking, runs = logged
    assert [*runs.evaluate] == ["release", "interiors"] and [*runs.train] == ["mlp-2d+3d"]
    ids = [*runs.evaluate.values(), *runs.train.values(), runs.learners, runs.paths, runs.benchmark]
    assert None not in ids and len({*ids}) == runs.new == 6
    again = log_release(release, tracking)
    assert again == ReleaseRuns(runs.evaluate, runs.train, runs.learners, runs.paths, runs.benchmark, new=0)
    pd.testing.assert_frame_equal(
        latest_scores(tracking, "release"), read_scores(release.root / "results" / "scores.csv")
    )
    assert (
        newest_artifact(tracking, "paths", "paths.csv").read_bytes()
        == (release.root / "results" / "paths.csv").read_bytes()
    )


def test_rows_over_all_scenes_are_nested(logged: tuple[Dataset, TrackingConfig, ReleaseRuns]) -> None:
    release, tracking, runs = logged
    scores = read_scores(release.root / "results" / "scores.csv")
    nested = children(tracking, runs.evaluate["release"])
    assert len(nested) == 2 * (len(METHODS) + 1)
    params, metrics = nested["mlp-2d+z (none)"]
    assert params["occlusion"] == "none" and params["dataset"] == "release" and params["scenes"] == "scene-0 scene-1"
    rows = scores.query("method == 'mlp-2d+z' and occlusion == 'none'").set_index(["top_n", "scene"])
    for n in (1, 5, 10):
        assert metrics[f"top-{n}/raw_0.05m_0.4deg"] == rows.loc[(n, "all"), "raw_0.05m_0.4deg"]
        assert metrics[f"top-{n}/scene-1/regret_5m_10deg"] == rows.loc[(n, "scene-1"), "regret_5m_10deg"]
    learners = children(tracking, str(runs.learners))
    assert {*learners} == {"bins 0", "set apartments 0", "set apartments 1"}
    assert learners["set apartments 1"][1]["regret_test"] == pytest.approx(0.2)
    assert learners["set apartments 1"][1]["average_precision/c"] == pytest.approx(0.9)
    assert children(tracking, str(runs.paths)).keys() == {
        f"paths {task} {method}" for task in ("planned", "given") for method in ("forward", "bins")
    }


def test_a_release_is_logged_as_its_evaluation_was(tmp_path: Path) -> None:
    """The same names, parameters and metrics; and in the store of the evaluation itself its run is found."""
    dataset = make_dataset(tmp_path / "tiny", ("test", "test"), n_locations=4, n_directions=6)
    (dataset.root / "weights").mkdir()
    own, other = TrackingConfig(str(tmp_path / "own")), TrackingConfig(str(tmp_path / "other"))
    config = EvaluateConfig(methods=("random", "bins"), resamples=20, top_n=(1, 2), occlusions=("none",))
    evaluate(dataset, config, own, progress=False)
    runs, found = log_release(dataset, other), log_release(dataset, own)
    (evaluated,) = finished_runs(own, "evaluate")
    assert found.new == 0 and found.evaluate == {"tiny": evaluated.info.run_id}
    theirs, ours = children(own, evaluated.info.run_id), children(other, runs.evaluate["tiny"])
    assert ours.keys() == theirs.keys() and len(ours) == 3
    for name, (params, metrics) in ours.items():
        assert metrics == theirs[name][1]
        assert params.items() - theirs[name][0].items() <= {("reference", "")}
    logged = client(other).get_run(runs.evaluate["tiny"]).data.metrics
    assert logged == client(own).get_run(evaluated.info.run_id).data.metrics


def test_only_what_is_new_is_logged(store: tuple[Dataset, TrackingConfig]) -> None:
    release, tracking = store
    table = pd.read_csv(release.root / "results" / "runtimes.csv")
    table.assign(median_s=9.0).to_csv(release.root / "results" / "runtimes.csv", index=False)
    before = client(tracking).get_run(newest_run(tracking, "benchmark").info.run_id)  # type: ignore[union-attr]
    runs = log_release(release, tracking)
    assert runs.new == 1 and runs.benchmark != before.info.run_id
    times = client(tracking).get_run(str(runs.benchmark)).data.metrics
    assert set(times.values()) == {9.0}


def test_histories_travel_with_a_release(store: tuple[Dataset, TrackingConfig]) -> None:
    release, tracking = store
    assert histories(tracking, "release") == {}
    history().assign(method="mlp-2d+3d").to_csv(release.root / "results" / "training.csv", index=False)
    run = log_release(release, tracking).train["mlp-2d+3d"]
    assert log_release(release, tracking).new == 0
    (found,) = histories(tracking, "release").values()
    pd.testing.assert_frame_equal(found, history())
    steps = client(tracking).get_metric_history(run, "val_average_precision")
    assert [(step.step, step.value) for step in steps] == [(0, 0.5), (1, 0.75), (2, 0.7)]
    assert trained(tracking, "release").iloc[0].to_dict() | {"calibration_error": None} == {
        "method": "mlp-2d+3d", "epoch": 1, "average_precision": 0.75, "roc_auc": 0.8, "calibration_error": None,
    }  # fmt: skip
    (release.root / "results" / "training.csv").unlink()  # and from the store back into the release
    pd.testing.assert_frame_equal(keep_histories(release, tracking).drop(columns="method"), history())
    assert (release.root / "results" / "training.csv").is_file()


def test_an_interrupted_run_is_not_taken_for_a_finished_one(store: tuple[Dataset, TrackingConfig]) -> None:
    release, tracking = store
    run = newest_run(tracking, "paths")
    assert run is not None
    mlflow = client(tracking)

    def names(condition: str) -> list[str]:
        found = mlflow.search_runs(list(experiment_ids(mlflow, tracking).values()), condition, max_results=10_000)
        return sorted(one.info.run_name for one in found)

    before = names("tags.stage = 'paths'")
    mlflow.update_run(run.info.run_id, status="RUNNING")  # as `kill -9` leaves it, with all that is nested in it
    runs = log_release(release, tracking)
    assert runs.new == 1 and runs.paths != run.info.run_id
    assert names("tags.stage = 'paths'") == before and len(before) > 1  # none twice
    assert log_release(release, tracking).new == 0


def test_notebooks_open_a_filled_store(
    logged: tuple[Dataset, TrackingConfig, ReleaseRuns], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WHERETOLOOK_MLRUNS", str(tmp_path / "mlruns"))
    monkeypatch.setenv("WHERETOLOOK_RELEASE", str(logged[0].root))
    tracking = open_store()
    assert tracking.root == tmp_path / "mlruns"
    assert newest_run(tracking, "train", params={"method": "mlp-2d+3d"}, file="mlp-2d+3d.json") is not None
    assert newest_run(tracking, "train", file=HISTORY_CSV) is None
    with pytest.raises(MissingRunError, match="no run of train with nothing"):
        newest_artifact(tracking, "train", "nothing")


def test_searches_of_the_page_on_runs_find_something(logged: tuple[Dataset, TrackingConfig, ReleaseRuns]) -> None:
    text, tracking = PAGE.read_text(), logged[1]
    queries = re.findall(r"^```\n(tags.*?)\n```", text, re.MULTILINE)
    queries += re.findall(r"^\| [a-z][^|]* \| `+ ?((?:tags|params|metrics).*?) ?`+(?: \||,)", text, re.MULTILINE)
    assert len(queries) == 7
    experiment = client(tracking).get_experiment_by_name(tracking.experiment)
    assert experiment is not None
    for query in queries:
        assert client(tracking).search_runs([experiment.experiment_id], query), query
    best = client(tracking).search_runs(
        [experiment.experiment_id], queries[0], order_by=["metrics.`top-1/regret_0.05m_0.4deg` ASC"]
    )
    values = [run.data.metrics["top-1/regret_0.05m_0.4deg"] for run in best]
    assert values == sorted(values) and len(values) == len(METHODS)
    for picture in re.findall(r"\]\((images/.*?)\)", text):
        assert (PAGE.parent / picture).stat().st_size < 150_000
