"""The contract of all learned methods: trained, stored, loaded, scored and evaluated alike."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from learning_options import changed, train_config
from synthetic_dataset import CAMERA, make_dataset
from wheretolook.commands.evaluate import evaluate_methods
from wheretolook.commands.train import train_methods
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.inputs.landmark_features import LandmarkDescriber
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.scorers.registry import learned, make_scorer, scorers
from wheretolook.scorers.set.network import MatchabilityNetwork
from wheretolook.scorers.weights import load_scorer
from wheretolook.tracking import TrackingConfig, client
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.weights import METADATA_KEY, method_of_weights, read_training
from wheretolook.utils.errors import ConfigError, OutOfRangeWarning, TableError, WeightsError

pytestmark = pytest.mark.usefixtures("no_pictures")

FEW = train_config(
    *learned(),
    epochs=3,
    batch_size=32,
    hidden=(16,),
    bins=6,
    matchability={"epochs": 6, "batch_size": 8, "learning_rate": 5e-3},
    set={"epochs": 4, "batch_size": 32, "landmarks": 32},
    conv={"epochs": 2, "batch_size": 64, "widths": (4, 8), "bins": 8},
    sphere={"points": 48, "cameras": 8, "width": 16, "heads": 2, "layers": 1, "epochs": 2, "batch_size": 40},
    trees={"max_trees": 10, "max_leaves": 7, "min_leaf": 5},
    accelerator="cpu",
)
SCORING = [name for name in learned() if name in scorers()]


@pytest.fixture(scope="module")
def tracking(tmp_path_factory):
    return TrackingConfig(folder=str(tmp_path_factory.mktemp("mlruns")))


@pytest.fixture(scope="module")
def trained(dataset, tracking):
    return {model.method: model for model in train_methods(dataset, FEW, tracking, progress=False)}


@pytest.mark.parametrize("name", learned())
def test_weights_and_run(name, trained, tracking):
    model = trained[name]
    assert not model.reused and np.isfinite(list(model.metrics.values())).all()
    assert method_of_weights(model.path) == name == read_training(model.path)["method"]
    record = json.loads(model.path.with_suffix(".json").read_text())
    assert record["about"] == read_training(model.path) and record["run_id"] == model.run_id
    run = client(tracking).get_run(model.run_id).data
    assert run.params["method"] == name and int(run.params["n_train"]) > 0
    assert run.metrics["kept_val_average_precision"] == pytest.approx(model.metrics["val_average_precision"])


def test_the_same_seed_gives_the_same_bytes_and_is_reused(dataset, trained, tracking):
    assert all(model.reused for model in train_methods(dataset, FEW, tracking, progress=False))
    names = tuple({"matchability", "set", "mlp-2d+z", "conv", "sphere", "trees"} & {*learned()})
    before = {name: trained[name].path.read_bytes() for name in names}
    train_methods(dataset, changed(FEW, methods=names), tracking, progress=False, force=True)
    assert {name: trained[name].path.read_bytes() for name in names} == before


def test_all_are_evaluated(dataset, trained, tracking):
    config = EvaluateConfig(methods=("bins", *SCORING), top_n=(1,), resamples=20)
    table = evaluate_methods(dataset, config, tracking, progress=False)
    rows = table[table["scene"] == "all"].set_index("method")
    assert {"bins", "oracle", *SCORING} == {*rows.index} and (rows["reference"] == "set").all()
    assert rows.loc["set", "roc_auc"] > 0.8 and np.isfinite(rows.loc[SCORING, "ece"].astype(float)).all()


def test_detection_is_learned_and_the_set_network_starts_from_it(dataset, trained):
    matchability = TrainedNetwork.load(trained["matchability"].path, MatchabilityNetwork, "matchability")
    localization_map = dataset.split("test")[0].localization_map(CAMERA)
    described = LandmarkDescriber(localization_map).describe(poses(dataset.split("test")[0].read_table())[:50])
    p_detect = matchability.calibrated(matchability.network(described.values)).sigmoid().numpy()
    ambiguity = localization_map.landmarks.ambiguity[described.rows.numpy()]
    assert p_detect[ambiguity < 0.4].mean() > 0.8 and p_detect[ambiguity > 0.6].mean() < 0.2
    assert read_training(trained["set"].path)["matchability_sha256"] is not None


@pytest.mark.parametrize(
    "change",
    [
        {"format_version": 99},
        {"method": "bins"},
        {"camera": {"width": 0}},
        {"scale": "x"},
        {"scale": -1},
        {"range": "x"},
        {"range": {"distance_m": [5.0, 1.0]}},
        {"range": {"distance_m": [float("nan"), 1.0]}},
        {},
        None,
    ],
)
def test_damaged_weights(change, trained, dataset, tmp_path):
    whole = trained["set"].path
    with safe_open(whole, framework="np") as file:
        header = json.loads(file.metadata()[METADATA_KEY])
    tensors = load_file(whole)
    if change is None:
        tensors.pop(sorted(tensors)[0])
    if change == {}:
        name = sorted(tensors)[0]
        tensors[name] = tensors[name] * np.inf
    path = tmp_path / "damaged.safetensors"
    localization_map = dataset.scenes[0].localization_map(CAMERA)
    save_file(tensors, path, metadata={METADATA_KEY: json.dumps(header | (change or {}))})
    with pytest.raises(WeightsError):
        load_scorer(localization_map, path)
    path.write_bytes(whole.read_bytes()[:-7])
    with pytest.raises(WeightsError):
        load_scorer(localization_map, path)


def warnings_of(scorer, cam_from_world):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scorer.score(cam_from_world)
    assert all(one.category is OutOfRangeWarning and one.filename == __file__ for one in caught)
    return [str(one.message) for one in caught]


@pytest.mark.parametrize("name", sorted({"set", "trees", "expected-inliers"} & {*scorers()}))
def test_views_outside_the_training_range_warn_once(dataset, trained, name):
    weights = trained[scorers()[name].weights].path
    scene = dataset.split("train")[0]
    localization_map = scene.localization_map(CAMERA)
    views = poses(scene.read_table())
    scorer = make_scorer(name, localization_map, weights=weights)
    assert scorer.in_range(views).mean() >= 0.95 and not warnings_of(scorer, views)
    landmarks = localization_map.landmarks
    far = views.copy()
    far[:, :, 3] *= 50
    farther = replace(landmarks, points=50 * landmarks.points, mapping_distance_m=50 * landmarks.mapping_distance_m)
    scorer = make_scorer(name, LocalizationMap(Map(farther), CAMERA), weights=weights)
    assert scorer.in_range(far).mean() < 0.9
    assert len(warnings_of(scorer, far)) == 1 and not warnings_of(scorer, far)


def test_matches_must_be_stored(tmp_path, tracking):
    with pytest.raises(TableError):
        train_methods(make_dataset(tmp_path), changed(FEW, methods=("matchability",)), tracking, progress=False)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("set", {"hidden": ("colour",)}),
        ("set", {"landmark_loss": -1}),
        ("set", {"epochs": 0}),
        ("matchability", {"width": 0}),
        ("matchability", {"enlarged": 0.5}),
    ],
)
def test_invalid_options(name, options):
    with pytest.raises(ConfigError):
        changed(FEW, **{name: options})
