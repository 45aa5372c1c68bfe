"""The convolutional network and the paper's network with landmark channels: what they can learn, on disk and back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.torch import load_file, save_file

from learning_options import changed, train_config
from synthetic_dataset import CAMERA, make_dataset, make_landmarks
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, UNLABELLED, poses, write_table
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.bins import InputStatistics
from wheretolook.inputs.channels import ALL_CHANNELS
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.scorers.binned_network import BinnedNetworkScorer
from wheretolook.scorers.mlp.network import ViewpointNetwork
from wheretolook.scorers.registry import make_scorer
from wheretolook.stages.evaluate import evaluate_methods as evaluate
from wheretolook.stages.train import train_methods as train
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.store import client
from wheretolook.training.data import ViewpointDataModule
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.weights import METADATA_KEY, method_of_weights, read_training
from wheretolook.utils.errors import ConfigError, OutOfRangeWarning, WeightsError
from wheretolook.weights.resolve import load_scorer
from wheretolook_paper.scorers.conv.config import ConvConfig
from wheretolook_paper.scorers.conv.network import ConvNetwork, ConvSpec

pytestmark = pytest.mark.usefixtures("no_pictures")

FEW = ConvConfig(epochs=2, batch_size=64, widths=(4, 8, 8), bins=12)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    """One MLflow store for all tests: making its database takes seconds."""
    return str(tmp_path_factory.mktemp("mlruns"))


@pytest.fixture
def trained() -> TrainedNetwork[ConvNetwork]:
    """An untrained network whose scores differ from view to view."""
    mean = (80.0, 60.0, 0.0, 0.0, 2.0, 0.5, 0.0, 1.5, 0.25, 2.0, 0.5, 0.5, 0.5, 0.2, -4.0)
    std = (40.0, 30.0, 1.0, 1.0, 1.0, *(0.3 for _ in range(10)))
    torch.manual_seed(0)
    network = ConvNetwork(ConvSpec(InputStatistics(ALL_CHANNELS, mean, std), 12, (8, 16), 0.5))
    return TrainedNetwork("conv", network, CAMERA, 1.7, -0.3)


def label_by(dataset: Dataset, channel: str, bins: int = 1) -> None:
    """Label views by the mean of a channel over what they see: those above the median localize.

    Views that see nothing have no label: that they see nothing would tell.
    """
    for scene in dataset.scenes:
        table = scene.read_table()
        binned = scene.localization_map(dataset.camera).bin_views(poses(table), bins, landmark_channels=True)
        filled = (binned.counts > 0).sum((1, 2))
        values = binned.select((channel,)).means.sum((1, 2, 3)) / np.maximum(filled, 1)
        good = values > np.median(values[filled > 0])
        errors = np.where(good, 0.001, np.nan)
        status = np.select([filled == 0, good], [UNLABELLED, LOCALIZED], NO_POSE)
        write_table(table.assign(status=status, error_m=errors, error_deg=errors), scene.table)


def make_one_wall_ambiguous(dataset: Dataset) -> None:
    """One wall in every other scene, the other wall in the rest, so that places do not tell which."""
    for number, scene in enumerate(dataset.scenes):
        landmarks = Landmarks.load(scene.landmarks)
        one_wall = (landmarks.points[:, 0] > landmarks.points[:, 1]) ^ (number % 2 == 1)
        replace(landmarks, ambiguity=(0.3 * landmarks.ambiguity + 0.6 * one_wall).astype(np.float32)).save(
            scene.landmarks
        )


def some_views() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    filled = torch.rand((20, 12, 12), generator=generator) < 0.3
    means = torch.rand((20, len(ALL_CHANNELS), 12, 12), generator=generator) * filled[:, None]
    means[:5, ALL_CHANNELS.index("ambiguity")] = torch.where(filled[:5], torch.nan, 0.0)
    return means, filled


def test_attributes_tell_a_network_what_places_cannot(tmp_path: Path, store: str) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("train", "train", "val"), n_locations=14, n_landmarks=200)
    make_one_wall_ambiguous(dataset)
    label_by(dataset, "ambiguity")
    config = train_config(
        "mlp-2d+3d", "mlp-2d+3d+landmark", epochs=8, batch_size=32, hidden=(32,), bins=6, accelerator="cpu"
    )
    without, told = train(dataset, config, TrackingConfig(store), progress=False)
    assert told.path.name == "mlp-2d+3d+landmark.safetensors"
    assert told.metrics["val_average_precision"] > 0.9
    assert without.metrics["val_average_precision"] < 0.8
    scorer = load_scorer(told.path, dataset.scenes[1].localization_map(CAMERA))
    assert isinstance(scorer, BinnedNetworkScorer) and scorer.name == "mlp-2d+3d+landmark"


def test_a_convolutional_network_learns_where_landmarks_are(tmp_path: Path, store: str) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("train", "val"), n_locations=20)
    label_by(dataset, "v", bins=8)
    options = replace(FEW, epochs=4, learning_rate=5e-3, bins=8)
    config = train_config("conv", accelerator="cpu", conv=options)
    (model,) = train(dataset, config, TrackingConfig(store), progress=False)
    assert model.metrics["val_average_precision"] > 0.85
    scorer = load_scorer(model.path, dataset.scenes[1].localization_map(CAMERA))
    table = dataset.scenes[1].read_table()
    table = table[table["status"] != UNLABELLED]
    far = poses(table)
    landmarks = scorer.localization_map.landmarks
    assert scorer.in_range(far).mean() > 0.9
    far[:, :, 3] *= 10
    larger = load_scorer(model.path, LocalizationMap(replace(landmarks, points=10 * landmarks.points), CAMERA))
    with pytest.warns(OutOfRangeWarning, match="mean depth of the filled bins") as caught:
        larger.score(far)
        larger.score(far)
    assert not larger.in_range(far).any() and len(caught) == 1
    good = (table["status"] == LOCALIZED).to_numpy()
    # calibrated on these views: the probabilities are right on average
    assert scorer.score(poses(table)).mean() == pytest.approx(good.mean(), abs=1e-3)


def test_only_who_looks_at_landmark_channels_has_them_loaded(tmp_path: Path, store: str) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("train", "val"), n_locations=4, n_directions=8)
    widths: list[int] = []

    class Watched(ViewpointDataModule):
        def setup(self, stage: str | None = None) -> None:
            super().setup(stage)
            widths.append(self.views.means.shape[1])

    config = train_config("mlp-2d", "mlp-2d+z", epochs=1, hidden=(4,), bins=4, accelerator="cpu")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wheretolook.scorers.mlp.learn.ViewpointDataModule", Watched)
        train(dataset, config, TrackingConfig(store), progress=False)
        assert {*widths} == {5}
        widths.clear()
        wide = changed(config, methods=("mlp-2d+3d+landmark", "mlp-2d", "mlp-released"))
        train(dataset, wide, TrackingConfig(store), progress=False, force=True)
    # one binning for both; the released code's options are others, and its inputs the paper's
    assert widths[0] == 15 and widths[-1] == 5


def test_the_paper_trains_as_before() -> None:
    assert train_config().methods == ("mlp-2d", "mlp-2d+z", "mlp-2d+3d", "set")  # what beats it learns beside it


def test_a_map_without_descriptors_trains_and_scores(tmp_path: Path, store: str) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("train", "train", "val"), n_locations=6, n_directions=12)
    for number, scene in enumerate(dataset.scenes):
        landmarks = Landmarks.load(scene.landmarks)
        unknown = np.full(len(landmarks), np.nan, dtype=np.float32)
        changes = {"mapping_distance_spread": unknown} | ({} if number == 1 else {"ambiguity": unknown})
        replace(landmarks, **changes).save(scene.landmarks)
    config = train_config("mlp-2d+3d+landmark", "conv", epochs=2, hidden=(8,), bins=6, accelerator="cpu", conv=FEW)
    models = train(dataset, config, TrackingConfig(store), progress=False)
    for model in models:
        assert np.isfinite(list(model.metrics.values())).all()
        for scene in dataset.scenes:
            scores = load_scorer(model.path, scene.localization_map(CAMERA)).score(poses(scene.read_table()))
            assert np.isfinite(scores).all() and len(np.unique(scores)) > 10


def test_training_logs_a_run_is_reused_and_evaluated(tmp_path: Path, store: str) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("train", "train", "test"), n_locations=8, n_directions=12)
    tracking = TrackingConfig(store, "conv")
    config = train_config("conv", accelerator="cpu", conv=FEW)
    (model,) = train(dataset, config, tracking, progress=False)
    assert model.path == dataset.root / "weights" / "conv.safetensors"
    run = client(tracking).get_run(model.run_id)
    assert (run.data.params["method"], run.data.params["epochs"], run.data.params["widths"]) == (
        "conv", "2", "[4, 8, 8]",
    )  # fmt: skip
    data = ViewpointDataModule(dataset, config, FEW, progress=False)
    data.setup()
    assert run.data.params["n_train"] == str(len(data.train_rows))  # all of them: nothing is balanced
    assert len(pd.read_csv(Path(run.info.artifact_uri) / "history.csv")) == 2
    assert [m.step for m in client(tracking).get_metric_history(model.run_id, "val_average_precision")] == [0, 1]

    # a network's options do not matter to it, its own do
    assert train(dataset, changed(config, learning_rate=0.5, bins=5), tracking, progress=False)[0].reused
    other = changed(config, conv=replace(FEW, dropout=0.0))
    assert not train(dataset, other, tracking, progress=False)[0].reused

    table = evaluate(dataset, EvaluateConfig(("bins", "conv"), resamples=50), tracking, progress=False)
    rows = table[(table["scene"] == "all") & (table["top_n"] == 1)].set_index("method")
    assert {*rows.index} == {"bins", "conv", "oracle"} and (rows["reference"] == "conv").all()
    assert 0 <= rows.loc["conv", "ece"] < 0.5


def test_a_network_comes_back_from_disk(trained: TrainedNetwork[ConvNetwork], tmp_path: Path) -> None:
    path = tmp_path / "weights" / "conv.safetensors"
    trained.save(path, {"method": "conv"})
    loaded = TrainedNetwork.load(path, ConvNetwork, "conv")
    views = some_views()
    assert loaded.network.spec == trained.network.spec and not loaded.network.training
    assert (loaded.camera, loaded.scale, loaded.offset) == (CAMERA, 1.7, -0.3)
    torch.testing.assert_close(loaded.network(*views), trained.network(*views), rtol=0, atol=0)
    assert loaded.network(*views).isfinite().all()
    content = path.read_bytes()
    loaded.save(path, {"method": "conv"})
    assert path.read_bytes() == content
    assert [file.name for file in path.parent.iterdir()] == ["conv.safetensors"]
    assert method_of_weights(path) == "conv" and read_training(path) == {"method": "conv"}
    with pytest.raises(WeightsError, match=r"conv\.safetensors.*not of mlp"):
        TrainedNetwork.load(path, ViewpointNetwork, "mlp-2d")


def test_damaged_networks_are_named(trained: TrainedNetwork[ConvNetwork], tmp_path: Path) -> None:
    path = tmp_path / "conv.safetensors"
    trained.save(path)
    tensors = load_file(path)
    header = json.loads(_header(path))
    for wrong, other, message in (
        ({}, {"method": "trees"}, "not of conv"),
        ({}, {"widths": [8, 15]}, "do not fit"),
        ({}, {"widths": []}, "damaged description"),
        ({}, {"camera": {"breadth": 3}}, "damaged description"),
        ({}, {"statistics": {"channels": ["u"], "mean": [0.0], "std": [1.0]}}, "do not fit"),
        ({}, {"statistics": {"channels": ["colour"], "mean": [0.0], "std": [1.0]}}, "unknown channel.*colour"),
        ({"last.weight": torch.zeros(1, 3)}, {}, "do not fit"),
    ):
        save_file({**tensors, **wrong}, path, metadata={METADATA_KEY: json.dumps({**header, **other})})
        with pytest.raises(WeightsError, match=message) as error:
            TrainedNetwork.load(path, ConvNetwork, "conv")
        assert str(path) in str(error.value)
    save_file(tensors, path, metadata={METADATA_KEY: json.dumps({**header, "method": "oracle"})})
    with pytest.raises(WeightsError, match="not of a scorer"):
        load_scorer(path, LocalizationMap(make_landmarks(np.random.default_rng(0), 10), CAMERA))


@pytest.mark.parametrize("wrong", [{"widths": ()}, {"widths": (8, 0)}, {"dropout": 1.0}, {"bins": 0}, {"epochs": 0}])
def test_options_that_are_none(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        ConvConfig(**wrong)  # type: ignore[arg-type]


def test_the_scorer_is_the_network_on_binned_views(
    trained: TrainedNetwork[ConvNetwork], tmp_path: Path, device: str
) -> None:
    path = tmp_path / "conv.safetensors"
    trained.save(path)
    rng = np.random.default_rng(1)
    views = poses_looking_along(rng.uniform((-1, -1, 1), (1, 1, 2), (40, 3)), rng.normal(size=(40, 3)))
    localization_map = LocalizationMap(make_landmarks(np.random.default_rng(0), 200), CAMERA, device=device)
    scorer = load_scorer(path, localization_map)
    assert isinstance(scorer, BinnedNetworkScorer) and scorer.name == "conv"
    binned = localization_map.bin_views(views, 12, landmark_channels=True)
    with torch.inference_mode():
        logits = trained.network(torch.from_numpy(binned.means), torch.from_numpy(binned.counts > 0)).double()
    scores = scorer.score(views)
    np.testing.assert_allclose(scores, (1.7 * logits - 0.3).sigmoid(), rtol=1e-5)
    assert len(np.unique(scores)) > 20  # some views see nothing
    narrow_bins = localization_map.bin_views(views, 12)  # without what the landmarks are like
    np.testing.assert_array_equal(scorer.score_binned(views, narrow_bins), scores)
    np.testing.assert_allclose([scorer.score(views[i : i + 1])[0] for i in range(5)], scores[:5], rtol=1e-6)

    double = PinholeCamera(2 * CAMERA.width, 2 * CAMERA.height, 2 * CAMERA.focal_px)
    same = load_scorer(path, replace(localization_map, camera=double))
    np.testing.assert_allclose(same.score(views), scores, rtol=1e-5)
    with pytest.raises(WeightsError, match=r"conv\.safetensors.*trained for a camera"):
        load_scorer(path, replace(localization_map, camera=replace(CAMERA, focal_px=40.0)))
    with pytest.raises(WeightsError, match="not of trees"):
        make_scorer("trees", localization_map, weights=path)


def _header(path: Path) -> str:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return str(file.metadata()[METADATA_KEY])
