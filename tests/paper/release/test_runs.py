"""A release logged as MLflow runs: once, as the stages log, and open to every search that the page on runs names."""

import dataclasses
import shutil

import pandas as pd
import pytest

from paper.release.synthetic_release import METHODS, history, make_release
from synthetic_dataset import make_dataset
from wheretolook.commands.evaluate import evaluate_methods as evaluate
from wheretolook.dataset.layout import Dataset
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.results import latest_scores, read_scores
from wheretolook.tracking import TrackingConfig, client, experiment_ids, finished_runs, newest_run
from wheretolook_paper.release.runs import log_release
from wheretolook_paper.release.training_histories import histories, keep_histories, trained


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logged")
    release = make_release(folder / "data" / "release")
    tracking = TrackingConfig(str(folder / "mlruns"))
    return release, tracking, log_release(release, tracking)


@pytest.fixture
def store(logged, tmp_path):
    """A release and its store that may be changed."""
    shutil.copytree(logged[0].root.parent.parent, tmp_path / "copy")
    release = Dataset.load(tmp_path / "copy" / "data" / "release")
    return release, TrackingConfig(str(tmp_path / "copy" / "mlruns"))


def children(tracking, parent):
    """Parameters and metrics of the runs nested in a run, by their names."""
    experiment = client(tracking).get_run(parent).info.experiment_id
    query = f"tags.mlflow.parentRunId = '{parent}'"
    runs = client(tracking).search_runs([experiment], query, max_results=1000)
    assert {run.info.status for run in runs} <= {"FINISHED"}
    return {run.info.run_name: (run.data.params, run.data.metrics) for run in runs}


def test_every_kind_of_result_becomes_a_run_once(logged):
    release, tracking, runs = logged
    names = {"evaluate", "learners", "paths", "looks", "extend", "benchmark"}
    names |= {"evaluate interiors", "train mlp-2d+3d"}
    assert runs.ids.keys() == names and len({*runs.ids.values()}) == runs.new == 8
    assert log_release(release, tracking) == dataclasses.replace(runs, new=0)
    scores = read_scores(release.root / "results" / "scores.csv")
    pd.testing.assert_frame_equal(latest_scores(tracking, "release"), scores)
    nested = children(tracking, runs.ids["evaluate"])
    assert len(nested) == 2 * (len(METHODS) + 1)
    params, metrics = nested["mlp-2d+z, none (evaluate release)"]
    assert params["occlusion"] == "none" and params["scenes"] == "scene-0 scene-1"
    rows = scores.query("method == 'mlp-2d+z' and occlusion == 'none'").set_index(["top_n", "scene"])
    assert metrics["top-5/raw_0.05m_0.4deg"] == rows.loc[(5, "all"), "raw_0.05m_0.4deg"]
    assert metrics["top-1/scene-1/regret_0.05m_0.4deg"] == rows.loc[(1, "scene-1"), "regret_0.05m_0.4deg"]
    last = children(tracking, runs.ids["learners"])["set, apartments, seed 1 (learners release)"][1]
    assert last["regret_test"] == last["1_regret"] == pytest.approx(0.2)
    assert children(tracking, runs.ids["paths"]).keys() == {
        f"{method}, {task} (paths release)" for task in ("planned", "given") for method in ("forward", "bins")
    }
    looks = children(tracking, runs.ids["looks"])
    assert looks["together, 2 looks (looks release)"][1] == {"good": 0.8, "any_good": 0.75}
    pairs = children(tracking, runs.ids["extend"])["pairs (extend release)"][1]
    assert pairs["gain"] == pytest.approx(0.2) and (pairs["won"], pairs["lost"], pairs["views"]) == (6, 2, 20)


def test_a_release_is_logged_as_its_evaluation_was(tmp_path):
    """The same names, parameters and metrics; and in the store of the evaluation itself its run is found."""
    dataset = make_dataset(tmp_path / "tiny", ("test", "test"), n_locations=4, n_directions=6)
    (dataset.root / "weights").mkdir()
    own = TrackingConfig(str(tmp_path / "own"))
    other = TrackingConfig(str(tmp_path / "other"))
    config = EvaluateConfig(methods=("random", "bins"), resamples=20, top_n=(1, 2), occlusions=("none",))
    evaluate(dataset, config, own, progress=False)
    runs = log_release(dataset, other)
    found = log_release(dataset, own)
    (evaluated,) = finished_runs(own, "evaluate")
    assert found.new == 0 and found.ids == {"evaluate": evaluated.info.run_id}
    theirs = children(own, evaluated.info.run_id)
    ours = children(other, runs.ids["evaluate"])
    assert ours.keys() == theirs.keys() and len(ours) == 3
    for name, (params, metrics) in ours.items():
        assert metrics == pytest.approx(theirs[name][1])  # sums differ by 1e-16 between machines
        assert params.items() - theirs[name][0].items() <= {("reference", "")}
    logged = client(other).get_run(runs.ids["evaluate"]).data.metrics
    assert logged == pytest.approx(client(own).get_run(evaluated.info.run_id).data.metrics)


def test_histories_travel_with_a_release(store):
    release, tracking = store
    assert histories(tracking, "release") == {}
    history().assign(method="mlp-2d+3d").to_csv(release.root / "results" / "training.csv", index=False)
    run = log_release(release, tracking).ids["train mlp-2d+3d"]
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


def test_an_interrupted_run_is_logged_again(store):
    release, tracking = store
    run = newest_run(tracking, "paths")
    assert run is not None
    mlflow = client(tracking)

    def names():
        found = mlflow.search_runs(experiment_ids(mlflow, tracking), "tags.stage = 'paths'", max_results=10_000)
        return sorted(one.info.run_name for one in found)

    before = names()
    mlflow.update_run(run.info.run_id, status="RUNNING")  # as `kill -9` leaves it, with all that is nested in it
    runs = log_release(release, tracking)
    assert runs.new == 1 and runs.ids["paths"] != run.info.run_id
    assert names() == before and len(before) > 1  # none twice
