"""What stages make of photographs that were left out: weights adapted by them, and rows of an evaluation."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from holdout.corridor import write_corridor
from synthetic_dataset import make_dataset
from wheretolook.cli import main, parse_command
from wheretolook.commands.check import WORK
from wheretolook.commands.evaluate import evaluate_methods
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.holdout.holdout import hold_out_blocks
from wheretolook.holdout.photo_map import open_map
from wheretolook.holdout.scores import evaluated_photographs
from wheretolook.mapping.config import FrameOptions
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.tracking import TrackingConfig, finished_runs
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.weights import read_training
from wheretolook.utils.package import WEIGHTS, shipped
from wheretolook.visibility.occlusion import NoOcclusion

pytestmark = pytest.mark.usefixtures("no_pictures")
SET = shipped(WEIGHTS) / "set.safetensors"


def run(arguments):
    parse_command("check", arguments).run()


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """The corridor's model and database, and the data folder with its check."""
    folder = tmp_path_factory.mktemp("place")
    sparse, database = write_corridor(folder / "corridor")
    where = ["--data", str(folder / "data"), "--occlusion", "none", "--workers", "1", "--device", "cpu"]
    run(["--map", str(sparse), "--database", str(database), "--scale", "1", *where])
    return sparse, database, folder / "data"


def adapt(checked, tmp_path, *options):
    sparse, database, data = checked
    where = ["--map", str(sparse), "--database", str(database), "--data", str(data), "--device", "cpu"]
    how = ["--occlusion.model", "none", "--label.workers", "1", "--tracking.folder", str(tmp_path / "mlruns")]
    return main(["adapt", *where, *how, *options])


def test_underconfident_weights_are_adapted_by_photographs(checked, tmp_path, capsys):
    sparse, database, data = checked
    bundled = TrainedNetwork.load(SET, SetNetwork, "set")
    replace(bundled, offset=bundled.offset - 4).save(tmp_path / "timid.safetensors", read_training(SET))
    before = {path: path.stat().st_mtime_ns for path in data.glob(f"checks/corridor/{WORK}/*/*/views.json")}
    assert adapt(checked, tmp_path, "--scale", "1", "--weights", str(tmp_path / "timid.safetensors")) == 0
    said = capsys.readouterr().out
    adapted = data / "checks" / "corridor" / "adapted.safetensors"
    assert "the adapted weights are better" in said
    assert before and before == {path: path.stat().st_mtime_ns for path in before}  # the check's blocks are found
    training = read_training(adapted)
    assert training["photographs"] == training["views"] > 60
    assert training["after"]["calibration_error"] < training["before"]["calibration_error"] / 2
    (logged,) = finished_runs(TrackingConfig(tmp_path / "mlruns"), "adapt")
    assert logged.data.params["photographs"] == str(training["photographs"])

    # a check scores with them, on maps of few of the landmarks too, and reports what they were trained on
    where = ["--map", str(sparse), "--database", str(database), "--scale", "1", "--occlusion", "none", "--workers", "1"]
    run([*where, "--data", str(data), "--device", "cpu", "--weights", str(adapted)])
    content = json.loads((data / "checks" / "corridor" / "check.json").read_text())
    assert content["method"] == "adapted" and content["ece"]["value"] < training["before"]["calibration_error"] / 2


def test_photographs_have_their_own_rows(checked, tmp_path):
    sparse, database, data = checked
    rendered = make_dataset(tmp_path / "data" / "both", ("test",), n_locations=14, n_directions=16)
    source = open_map(sparse, database, frame=FrameOptions(scale=1))
    blocks = hold_out_blocks(source, data / "checks" / "corridor" / "work")
    photographs = evaluated_photographs(rendered.scenes[0], source, blocks, NoOcclusion())
    config = EvaluateConfig(("random", "visible", "set"), weights=(SET,), resamples=50, top_n=(1,), photographs=True)
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    table = evaluate_methods(rendered, config, tracking, progress=False, photographs=[photographs])
    assert list(table["candidates"].unique()) == ["all", "photographs"]
    rows = table[(table["candidates"] == "photographs") & (table["scene"] == "all")].set_index("method")
    # the same number as in the check of the same blocks
    numbers = json.loads((data / "checks" / "corridor" / "check.json").read_text())
    assert rows.loc["visible", "roc_auc"] == pytest.approx(numbers["methods"]["visible"]["auc"]["value"])
    assert rows.loc["oracle", "n_locations"] == len(np.unique(photographs.views["place"]))
    views = pd.read_csv(data / "checks" / "corridor" / "views.csv")
    assert photographs.views["photograph"].tolist() == views["row"].tolist()


@pytest.mark.slow
def test_a_scene_of_photographs_alone_is_evaluated_and_adapted_to(checked, tmp_path):
    sparse, database, _ = checked
    where = ["--name", "mine", "--data", str(tmp_path / "data"), "--tracking.folder", str(tmp_path / "mlruns")]
    where += ["--device", "cpu", "--label.workers", "1"]
    model = ["--model", str(sparse), "--database", str(database), "--mapping.existing.camera_id", "1"]
    assert main(["map", *where, *model]) == 0
    methods = ["--evaluate.methods", "[visible, set]", "--evaluate.weights", f"[{SET}]"]
    assert main(["evaluate", *where, *methods, "--evaluate.photographs", "true"]) == 0
    table = pd.read_csv(tmp_path / "data" / "mine" / "results" / "scores.csv")
    assert set(table["candidates"]) == {"photographs"} and (table.loc[table["method"] == "set", "roc_auc"] > 0.9).all()
    assert main(["adapt", *where]) == 0
    assert (tmp_path / "data" / "mine" / "adapted" / "corridor.md").is_file()
