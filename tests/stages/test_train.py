"""The data module and the train stage on a tiny dataset whose labels follow a known rule."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from learning_options import changed, train_config
from synthetic_dataset import make_dataset
from wheretolook.commands.train import train_methods as train
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_files import write_table
from wheretolook.dataset.viewpoint_table import NO_POSE, UNLABELLED, is_good
from wheretolook.scorers.mlp.network import ViewpointNetwork
from wheretolook.scorers.weights import load_scorer
from wheretolook.tracking import TrackingConfig, client
from wheretolook.training.data import ViewpointDataModule, hold_out_locations
from wheretolook.training.provenance import training_fingerprint, was_trained_on
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import ConfigError, TableError

pytestmark = pytest.mark.usefixtures("no_pictures")

SMALL = train_config("mlp-2d", epochs=3, hidden=(32,), accelerator="cpu")


def load(path):
    """The paper's network that lies in a file."""
    return TrainedNetwork.load(path, ViewpointNetwork, path.stem).network


def data_of(dataset, config):
    """The views that the paper's network learns from."""
    return ViewpointDataModule(dataset, config, config.mlp, progress=False)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """One MLflow store for all tests: making its database takes seconds."""
    return str(tmp_path_factory.mktemp("mlruns"))


@pytest.fixture
def dataset(tmp_path):
    return make_dataset(tmp_path / "data" / "tiny")


def test_held_out_locations_are_whole_and_the_same_for_the_same_seed():
    scene = np.repeat([0, 0, 0, 0, 1, 1], 5)
    location = np.repeat([3, 5, 7, 9, 3, 5], 5)
    held_out = hold_out_locations(scene, location, 0.3, seed=4)
    for number in (0, 1):
        inside, outside = ({*location[(scene == number) & rows]} for rows in (held_out, ~held_out))
        assert inside and outside and not inside & outside
    assert len({*location[(scene == 0) & held_out]}) == 2  # 30 % of 4, rounded up
    np.testing.assert_array_equal(held_out, hold_out_locations(scene, location, 0.3, seed=4))
    assert not hold_out_locations(scene[:5], location[:5], 0.3, seed=0).any()  # the only location is trained on


def test_data_module_reads_labelled_train_views_only(dataset):
    scene = dataset.scenes[0]
    table = scene.read_table()
    table.loc[table.index[::3], "status"] = UNLABELLED
    write_table(table, scene.table)
    data = data_of(dataset, train_config(accelerator="cpu"))
    labelled = pd.concat([table[table["status"] != UNLABELLED], dataset.scenes[1].read_table()])
    np.testing.assert_array_equal(data.views.labels.numpy() > 0, is_good(labelled))
    np.testing.assert_array_equal(data.views.filled.any(2).any(1).numpy(), labelled["n_visible"] > 0)
    sides = [{(data.views.scene[row], data.views.location[row]) for row in rows.tolist()}
             for rows in (data.train_rows, data.val_rows)]  # fmt: skip
    assert not sides[0] & sides[1]
    assert len(data.train_rows) + len(data.val_rows) == len(data.views)
    labels = data.views.labels[data.train_rows]
    n_good = labels.sum().item()
    assert data.class_weights == pytest.approx((len(labels) / 2 / (len(labels) - n_good), len(labels) / 2 / n_good))


def test_validation_scenes_are_used_where_there_are_some(tmp_path):
    dataset = make_dataset(tmp_path / "tiny", ("train", "val", "test"), n_locations=6, n_directions=12)
    data = data_of(dataset, SMALL)
    assert {*data.views.scene[data.train_rows]} == {0}
    assert {*data.views.scene[data.val_rows]} == {1}


def test_every_epoch_visits_every_training_view_once_in_its_own_order(dataset):
    data = data_of(dataset, changed(SMALL, batch_size=100))
    loader = data.train_dataloader()
    first, second = (torch.cat([batch.labels for batch in loader]) for _ in range(2))
    assert len(first) == len(data.train_rows) and first.sum() == data.views.labels[data.train_rows].sum()
    assert not torch.equal(first, second)
    assert torch.equal(first, torch.cat([batch.labels for batch in data.train_dataloader()]))


def test_balanced_training_views_are_equally_many_and_all_of_the_rarer_class(dataset):
    for scene in dataset.split("train"):
        table = scene.read_table()
        write_table(table.assign(status=np.where(table.index % 4 == 0, table["status"], NO_POSE)), scene.table)
    plain, balanced = (data_of(dataset, changed(SMALL, balance=balance)) for balance in (False, True))
    positives = {*plain.train_rows[plain.views.labels[plain.train_rows] > 0].tolist()}
    chosen = {*balanced.train_rows.tolist()}
    assert 0 < len(positives) < len(plain.train_rows) / 3
    assert len(chosen) == len(balanced.train_rows) == 2 * len(positives)
    assert positives < chosen < {*plain.train_rows.tolist()}
    assert balanced.class_weights == (1.0, 1.0)
    assert torch.equal(plain.val_rows, balanced.val_rows)


@pytest.mark.parametrize(
    "options",
    [
        {"methods": ("mlp-2d", "mlp-5d")}, {"epochs": 0}, {"dropout": 1.0}, {"val_fraction": 0.0},
        {"layout": "sideways"}, {"learning_rate": float("nan")}, {"l2": -1.0}, {"devices": 0},
    ],
)  # fmt: skip
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ConfigError):
        changed(SMALL, **options)


def test_training_learns_the_rule_logs_a_run_and_is_reused(dataset, store):
    tracking = TrackingConfig(store, "tiny")
    config = changed(SMALL, methods=("mlp-2d", "mlp-2d+3d"), epochs=4, noise_px=0.5, noise_m=0.02, schedule="cosine")
    models = train(dataset, config, tracking, progress=False)
    for method, model in zip(config.methods, models, strict=True):
        assert model.method == method and model.metrics["val_average_precision"] > 0.9
        run = client(tracking).get_run(model.run_id)
        assert (run.info.status, run.data.params["method"]) == ("FINISHED", method)
        history = client(tracking).get_metric_history(model.run_id, "val_average_precision")
        assert [metric.step for metric in history] == [0, 1, 2, 3]
        assert max(metric.value for metric in history) == pytest.approx(model.metrics["val_average_precision"])
        artifacts = Path(run.info.artifact_uri)
        assert len(pd.read_csv(artifacts / "history.csv")) == 4
        assert (artifacts / model.path.name).read_bytes() == model.path.read_bytes()

    before = {path: path.stat().st_mtime_ns for path in (dataset.root / "weights").iterdir()}
    again = train(dataset, config, tracking, progress=False)
    assert [(model.run_id, model.reused) for model in again] == [(model.run_id, True) for model in models]
    assert {path: path.stat().st_mtime_ns for path in before} == before
    models[0].path.write_bytes(b"changed")
    scene = dataset.split("test")[0]
    write_table(scene.read_table().iloc[:-1], scene.table)  # test scenes do not change the training
    assert [model.reused for model in train(dataset, config, tracking, progress=False)] == [False, True]


def test_further_datasets_are_trained_on(dataset, store):
    other = make_dataset(dataset.root.parent / "other", ("val", "test", "test", "test", "train"), n_locations=5)
    tracking = TrackingConfig(store, "also")
    config = changed(SMALL, epochs=1, also=("other",))
    (model,) = train(dataset, config, tracking, progress=False)
    about = json.loads(model.path.with_suffix(".json").read_text())["about"]
    together = Dataset(dataset.root, (*dataset.scenes, *other.split("train")))
    assert about["also"] == ["other"] and about["dataset_fingerprint"] == training_fingerprint(together)
    views = client(tracking).get_run(model.run_id).data.params
    assert int(views["n_train"]) + int(views["n_val"]) == (2 * 24 + 5) * 20
    assert was_trained_on(dataset, about) and not was_trained_on(dataset, {**about, "also": []})
    (again,) = train(dataset, config, tracking, progress=False)
    (without,) = train(dataset, changed(config, also=()), tracking, progress=False)
    assert again.reused and not without.reused


def test_invalid_further_datasets(dataset, store):
    other = make_dataset(dataset.root.parent / "other", ("test", "train"), n_locations=5)
    make_dataset(dataset.root.parent / "tests", ("test",), n_locations=2)
    shutil.copy(dataset.split("test")[0].landmarks, other.scenes[1].landmarks)  # would train on a test scene
    for names, error in (
        (("nowhere",), TableError),
        (("tests",), TableError),
        (("tiny",), ConfigError),
        (("other",), ConfigError),
    ):
        with pytest.raises(error):
            train(dataset, changed(SMALL, also=names), TrackingConfig(store, "also"), progress=False)


def test_the_same_seed_gives_the_same_weights(dataset, store):
    config = changed(SMALL, noise_px=1.0)
    tracking = TrackingConfig(store, "same seed")
    torch.manual_seed(123)
    first = train(dataset, config, tracking, progress=False)[0].path.read_bytes()
    torch.manual_seed(456)
    state = torch.get_rng_state()
    assert train(dataset, config, tracking, progress=False, force=True)[0].path.read_bytes() == first
    assert torch.equal(torch.get_rng_state(), state)  # training leaves the caller's random numbers alone
    assert train(dataset, changed(config, seed=1), tracking, progress=False)[0].path.read_bytes() != first


@pytest.mark.slow
def test_two_processes_train_as_one_does(dataset, store):
    # 920 training views: the last batch has one view, so that one of two processes has none
    tracking = TrackingConfig(store, "devices")
    one = changed(SMALL, dropout=0.0, batch_size=919)
    (alone,) = train(dataset, one, tracking, progress=False)
    expected = load(alone.path).state_dict()
    (shared,) = train(dataset, changed(one, devices=2), tracking, progress=False, force=True)
    for name, weights in load(shared.path).state_dict().items():
        torch.testing.assert_close(weights, expected[name], rtol=1e-4, atol=1e-5)
    assert shared.metrics == pytest.approx(alone.metrics, rel=1e-4)
    experiment = client(tracking).get_experiment_by_name("devices")
    runs = client(tracking).search_runs([experiment.experiment_id])
    assert {run.info.run_id for run in runs} == {alone.run_id, shared.run_id}
    # weights do not depend on the number of devices
    assert train(dataset, one, tracking, progress=False)[0].reused


def test_the_released_variant_trains_as_the_released_code(dataset, store):
    config = changed(SMALL, methods=("mlp-2d+3d", "mlp-released"), epochs=2, hidden=(16,))
    ours, released = train(dataset, config, TrackingConfig(store), progress=False)
    spec = load(released.path).spec
    assert (spec.layout, spec.input_dropout, spec.hidden) == ("compact", 0.5, (300, 300))
    assert spec.channels == ("u", "v", "x", "y", "z")
    params = client(TrackingConfig(store)).get_run(released.run_id).data.params
    expected = {"learning_rate": "0.0001", "l2": "0.0", "balance": "True", "keep": "last", "epochs": "2"}
    assert {name: params[name] for name in expected} == expected
    assert float(params["positives_train"]) == 0.5  # classes weigh the same
    assert released.metrics["epoch"] == 1  # the last, whichever was best
    assert load(ours.path).spec.layout == "in_place"
    localization_map = dataset.scenes[0].localization_map(dataset.camera)
    assert load_scorer(localization_map, released.path).name == "mlp-released"
