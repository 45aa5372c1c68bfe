"""Results of stages whose logging fails: they are kept, a warning says so, and the stage run again logs them."""

import json
from pathlib import Path

import pandas as pd
import pytest
from tests.learning_options import train_config
from tests.synthetic_dataset import make_dataset

from wheretolook.commands.evaluate import evaluate_methods, not_logged
from wheretolook.commands.label import log_labels
from wheretolook.commands.train import train_methods
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.tracking import TrackingConfig, artifact, client, finished_runs
from wheretolook.training.fit import EpochRecord
from wheretolook.utils.errors import TrackingError, TrackingWarning
from wheretolook.utils.files import sha256
from wheretolook_paper.release.training_histories import keep_histories, train_runs

pytestmark = pytest.mark.usefixtures("no_pictures")

SMALL = train_config("mlp-2d", epochs=3, hidden=(8,), accelerator="cpu")


@pytest.fixture
def dataset(tmp_path):
    return make_dataset(tmp_path / "tiny", ("train", "val", "test"), n_locations=6, n_directions=8)


@pytest.fixture
def tracking(tmp_path):
    return TrackingConfig(str(tmp_path / "mlruns"))


def break_store(tracking):
    """Nothing can be stored with runs from now on."""
    folder = Path(tracking.artifacts)
    if folder.is_dir():
        folder.rename(folder.with_name("kept"))
    folder.write_text("no folder")


def mend_store(tracking):
    folder = Path(tracking.artifacts)
    folder.unlink()
    folder.with_name("kept").rename(folder)


def test_a_training_that_cannot_be_logged_is_kept_and_logged_later(dataset, tracking, monkeypatch):
    end = EpochRecord.on_train_end
    with monkeypatch.context() as patch:
        patch.setattr(EpochRecord, "on_train_end", lambda *given: (break_store(tracking), end(*given))[1])
        with pytest.warns(TrackingWarning):
            (model,) = train_methods(dataset, SMALL, tracking, progress=False)
    assert model.run_id == "" and not model.reused
    digest = sha256(model.path)
    with pytest.raises(TrackingError):
        train_methods(dataset, SMALL, tracking, progress=False)
    mend_store(tracking)
    assert len(keep_histories(dataset, tracking)) == 3
    (again,) = train_methods(dataset, SMALL, tracking, progress=False)
    assert again.reused and sha256(model.path) == digest
    ((method, run),) = train_runs(tracking, "tiny")
    assert method == "mlp-2d" and run.info.run_id == again.run_id
    assert artifact(tracking, again.run_id, model.path.name).read_bytes() == model.path.read_bytes()
    logged = client(tracking).get_metric_history(again.run_id, "val_bce")
    table = pd.read_csv(artifact(tracking, again.run_id, "history.csv"))
    assert [metric.value for metric in logged] == pytest.approx(list(table["val_bce"]), rel=1e-12)


def test_an_evaluation_that_cannot_be_logged_is_kept_and_logged_later(dataset, tracking, monkeypatch):
    from wheretolook.evaluation import scoring

    config = EvaluateConfig(("random", "visible"), resamples=50, top_n=(1,))
    compare = scoring.compare_methods
    with monkeypatch.context() as patch:
        patch.setattr(scoring, "compare_methods", lambda *given: (break_store(tracking), compare(*given))[1])
        with pytest.warns(TrackingWarning):
            table = evaluate_methods(dataset, config, tracking, progress=False)
    scores = (dataset.root / "results" / "scores.csv").read_bytes()
    assert len(table) and not_logged(dataset).is_file()
    mend_store(tracking)
    evaluate_methods(dataset, config, tracking, progress=False)
    (logged,) = finished_runs(tracking, "evaluate")
    assert artifact(tracking, logged.info.run_id, "scores.csv").read_bytes() == scores
    assert not not_logged(dataset).exists()


def test_labels_that_cannot_be_logged_are_summarized_and_logged_later(dataset, tracking):
    tracking.root.mkdir()
    (tracking.root / "kept").mkdir()
    (tracking.root / "artifacts").write_text("")
    with pytest.warns(TrackingWarning):
        log_labels(dataset, tracking, {"render": 1.5})
    assert (dataset.root / "results" / "labels.md").is_file()
    note = dataset.root / "labels_not_logged.json"
    assert json.loads(note.read_text()) == {"render": 1.5}
    mend_store(tracking)
    log_labels(dataset, tracking)
    (run,) = finished_runs(tracking, "label")
    assert run.data.metrics["seconds_render"] == 1.5 and not note.exists()
