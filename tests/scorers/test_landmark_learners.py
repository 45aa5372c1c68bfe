"""Learners that look at landmarks one by one: which are found, and what a view may expect of them."""

from __future__ import annotations

import gc
import json
import warnings
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from safetensors.numpy import load_file, save_file

from learning_options import changed, train_config
from synthetic_dataset import CAMERA, make_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import LOCALIZED, is_good, poses, read_table, write_table
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.geometry import pose_information as information
from wheretolook.geometry.poses import Float
from wheretolook.inputs.landmark_features import ATTRIBUTES, LandmarkDescriber, ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.matchability.config import MatchabilityConfig
from wheretolook.scorers.matchability.learn import LandmarkBatches
from wheretolook.scorers.matchability.network import MatchabilityNetwork, bearing_numbers, expected_parts
from wheretolook.scorers.registry import make_scorer
from wheretolook.scorers.set.config import SetConfig
from wheretolook.scorers.set.learn import of_size
from wheretolook.scorers.set.network import (
    EXPECTED,
    SetNetwork,
    expected_cells,
    expected_statistics,
    information_matrices,
)
from wheretolook.scorers.set.score import SetScorer
from wheretolook.stages.evaluate import evaluate_methods as evaluate
from wheretolook.stages.train import train_methods as train
from wheretolook.tracking.config import TrackingConfig
from wheretolook.training.data import labelled_rows
from wheretolook.training.landmark_views import AttributeStatistics, LandmarkLoader, load_landmark_views
from wheretolook.training.scenes import training_scenes
from wheretolook.training.trained_network import StoredNetwork, TrainedNetwork
from wheretolook.training.weights import METADATA_KEY, method_of_weights, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, OutOfRangeWarning, TableError, WeightsError
from wheretolook.weights.resolve import load_scorer

pytestmark = pytest.mark.usefixtures("no_pictures")

DISTANCE = ATTRIBUTES.index("distance")
NO_STATISTICS = AttributeStatistics((0.0,) * len(ATTRIBUTES), (1.0,) * len(ATTRIBUTES))


def attributes_of(offsets: np.ndarray) -> torch.Tensor:
    """Attributes of landmarks at offsets (N, 3) in the camera's axes; what a map tells of them is 0."""
    values = np.zeros((len(offsets), len(ATTRIBUTES)))
    values[:, 0] = offsets[:, 0] / offsets[:, 2]
    values[:, 1] = offsets[:, 1] / offsets[:, 2]
    values[:, DISTANCE] = np.log(np.linalg.norm(offsets, axis=1))
    values[:, ATTRIBUTES.index("pixel_angle")] = -np.log(320)
    return torch.from_numpy(values)


def some_offsets(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-1, -1, 1), (1, 1, 4), (n, 3))


def test_the_information_is_that_of_the_fisher_package() -> None:
    offsets = some_offsets(40)
    numbers = bearing_numbers(attributes_of(offsets))
    np.testing.assert_allclose(numbers, information.bearing_numbers(offsets), rtol=1e-9, atol=1e-12)
    matrices = information_matrices(numbers)
    np.testing.assert_allclose(matrices, information.information_matrices(numbers.numpy()), rtol=1e-12)


def test_expectations_in_closed_form() -> None:
    offsets = some_offsets(50)
    values = attributes_of(offsets)
    rng = np.random.default_rng(1)
    odds = torch.from_numpy(rng.normal(size=50))
    focal_px = 500.0  # pixels on the landmark's surface, over those that mapped it
    ratio = rng.normal(size=50)
    values[:, ATTRIBUTES.index("pixel_angle")] = -np.log(focal_px)
    values[:, ATTRIBUTES.index("pixel_size_ratio")] = torch.from_numpy(ratio)
    sums = expected_parts(values, odds).sum(0, keepdim=True)
    found = dict(zip(EXPECTED, expected_statistics(sums, torch.tensor([50]))[0].tolist(), strict=True))
    p = 1 / (1 + np.exp(-odds.numpy()))
    # a keypoint is off by a pixel of the camera, and the landmark by one of the images that mapped it
    weight = p * (focal_px / 320) ** 2 / (1 + np.exp(-2 * ratio))
    matrix = information.information_matrices((weight[:, None] * information.bearing_numbers(offsets)).sum(0))
    covariance = np.linalg.inv(matrix + 1e-3 * np.eye(6))
    pixels = values[:, :2].numpy()
    spread = np.linalg.det(np.cov(pixels.T, aweights=p, ddof=0))
    expected = {
        "log_expected_inliers": np.log1p(p.sum()),
        "log_visible": np.log(51),
        "log_expected_share": None,
        "log_position_variance": np.log(np.trace(covariance[:3, :3])),
        "log_orientation_variance": np.log(np.trace(covariance[3:, 3:])),
        "log_det_information": np.linalg.slogdet(matrix + 1e-3 * np.eye(6))[1],
        "log_variance_z": np.log(covariance[2, 2]),
        "log_spread": np.log(spread + 1e-4),
    }
    for name, value in expected.items():
        if value is not None:
            assert found[name] == pytest.approx(value, rel=1e-5), name
    assert found["expected_share"] == pytest.approx(p.mean(), rel=1e-5)


def test_expected_cells_in_closed_form() -> None:
    """Two landmarks share a cell, one lies elsewhere, one is 90 degrees off; another view has one, a third none."""
    degrees = np.array([[1.0, 1.0], [5.0, 3.0], [-40.0, 20.0], [89.99, 0.0], [0.5, 0.5]])
    values = torch.zeros(5, len(ATTRIBUTES), dtype=torch.float64)
    values[:, :2] = torch.from_numpy(np.tan(np.deg2rad(degrees)))
    chance = np.array([0.3, 0.6, 0.25, 0.5, 0.9])
    odds = torch.from_numpy(np.log(chance / (1 - chance)))
    views = torch.tensor([0, 0, 0, 0, 1])
    each = torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)
    found = expected_cells(values, odds, views, each)
    # the second view's landmark stands for two: it is missed only if both are
    np.testing.assert_allclose(found, [1 - 0.7 * 0.4 + 0.25 + 0.5, 1 - 0.1**2, 0], rtol=1e-12)


def test_weights_that_give_no_numbers_are_told() -> None:
    with pytest.raises(WeightsError, match="these weights give no numbers"):
        expected_statistics(torch.full((1, 21), torch.nan), torch.tensor([50]))


def test_more_landmarks_leave_less_error_to_expect() -> None:
    few, many = (attributes_of(np.tile(some_offsets(20), (n, 1))) for n in (1, 10))
    likely = [torch.full((len(values),), 2.0).double() for values in (few, many)]
    sums = torch.stack([expected_parts(v, o).sum(0) for v, o in zip((few, many), likely, strict=True)])
    statistics = expected_statistics(sums, torch.tensor([20, 200]))
    ratio = statistics[1] - statistics[0]
    for name in ("log_position_variance", "log_variance_x", "log_orientation_variance"):
        assert ratio[EXPECTED.index(name)] == pytest.approx(-np.log(10), abs=0.1)  # variance falls as one over n


def test_chances_are_learnt_beside_the_labels_from_known_matches_only() -> None:
    network = SetNetwork(NO_STATISTICS).eval()
    values = torch.randn(3, 5, len(ATTRIBUTES))
    taken = torch.tensor([5, 2, 0])
    found = torch.full((3, 5), torch.nan)
    found[0] = torch.tensor([1.0, 0, 0, 1, 0])
    found[1, :2] = 1.0
    views = values, taken, taken, torch.zeros(3)
    logits, loss = network.learn_more(SetConfig(landmark_loss=0.5, landmarks=10), 4.0, *views, found)
    torch.testing.assert_close(logits, network(*views))
    chance = network.matchability(values).sigmoid()
    missed = -(found * chance.log() + (1 - found) * (1 - chance).log())
    assert float(loss) == pytest.approx(0.5 * float(missed.nansum()) / (4 * 10), rel=1e-5)
    assert float(network.learn_more(SetConfig(), 4.0, *views, torch.full_like(found, torch.nan))[1]) == 0


def test_views_without_landmarks_are_scored() -> None:
    network = SetNetwork(NO_STATISTICS, pooled=3).eval()
    empty = ViewLandmarks(torch.tensor([0, 0, 0]), torch.zeros(0, dtype=torch.int64), torch.zeros(0, len(ATTRIBUTES)))
    logits = network.score(empty, empty.counts, torch.zeros(2))
    assert logits.shape == (2,) and torch.isfinite(logits).all()


@pytest.mark.parametrize("pooled", [0, 4])
def test_a_sample_of_all_landmarks_scores_as_all_of_them(pooled: int) -> None:
    torch.manual_seed(0)
    network = SetNetwork(NO_STATISTICS, pooled=pooled).eval()
    counts = torch.tensor([30, 1, 17])
    starts = torch.tensor([0, 30, 31, 48])
    values = attributes_of(some_offsets(48)).float()
    padded = torch.full((3, 30, len(ATTRIBUTES)), 7.0)
    for view in range(3):
        padded[view, : counts[view]] = values[starts[view] : starts[view + 1]]
    height = torch.tensor([0.1, -0.2, 0.3])
    whole = network.score(ViewLandmarks(starts, torch.zeros(48, dtype=torch.int64), values), counts, height)
    torch.testing.assert_close(network(padded, counts, counts, height), whole, rtol=1e-4, atol=1e-5)


def test_what_is_not_known_is_the_mean_and_what_is_hidden_does_not_matter() -> None:
    values = torch.randn(100, len(ATTRIBUTES))
    values[:, -1] = torch.nan
    statistics = AttributeStatistics.of(values)
    assert statistics.mean[-1] == 0 and statistics.std[-1] == 1
    assert statistics.mean[0] == pytest.approx(float(values[:, 0].mean()), rel=1e-5)
    network = MatchabilityNetwork(statistics, hidden=("ambiguity",))
    known = values.clone()
    known[:, -1] = 0
    assert torch.equal(network(values), network(known))
    column = ATTRIBUTES.index("ambiguity")
    known[:, column] += 1
    assert torch.equal(network(values), network(known))
    known[:, 0] += 1
    assert not torch.equal(network(values), network(known))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Labels by filled bins; a landmark is found if its descriptor is unlike others."""
    made = make_dataset(tmp_path_factory.mktemp("data"))
    for scene in made.scenes:
        table = read_table(scene.table)
        localization_map = scene.localization_map(CAMERA)
        visible = localization_map.landmarks_in_view(poses(table))
        clear = localization_map.landmarks.ambiguity < 0.5
        found = [rows[clear[rows]].astype(np.int32) for rows in (visible[view] for view in range(len(table)))]
        strangers = np.array([len(clear) - 1], dtype=np.int32)  # matched, but perhaps not in view
        matched = [np.union1d(rows, strangers).astype(np.int32) for rows in found]
        write_table(table.assign(matched_rows=matched, inlier_rows=found), scene.table)
    return made


def test_views_by_their_landmarks(dataset: Dataset) -> None:
    scenes = training_scenes(dataset)
    views = load_landmark_views(dataset, scenes, train_config(), 20, progress=False, matches=True)
    at = 0
    assert views.found is not None
    for number, scene in enumerate(scenes):
        table = scene.read_table(matches=True)
        described = LandmarkDescriber(scene.localization_map(CAMERA)).describe(poses(table))
        for view in range(len(table)):
            all_values = described.values[described.starts[view] : described.starts[view + 1]].half()
            rows = described.rows[described.starts[view] : described.starts[view + 1]].numpy()
            part = slice(int(views.starts[at]), int(views.starts[at + 1]))
            kept = views.values[part]
            assert len(kept) == min(20, len(all_values)) and views.n_visible[at] == len(all_values)
            inliers = table["inlier_rows"].iloc[view] if table["status"].iloc[view] == LOCALIZED else None
            if inliers is not None and not is_good(table.iloc[[view]], 0.5, 5.0)[0]:
                inliers = []  # of a pose elsewhere: the map looks alike there, and these are wrong matches
            for values, found in zip(kept, views.found[part], strict=True):
                row = rows[(all_values == values).all(1).numpy()]
                assert len(row) == 1
                if inliers is not None:
                    assert bool(found) == (row[0] in inliers)
            assert views.scene[at] == number
            at += 1
    assert at == len(views)


def test_batches_hold_samples_of_each_view(dataset: Dataset) -> None:
    views = load_landmark_views(dataset, training_scenes(dataset), train_config(), 40, progress=False)
    rows = torch.arange(5, len(views))
    loader = LandmarkLoader(views, rows, 64, width=8, shuffle_seed=3)
    first, second = (torch.cat([batch.inputs[2] for batch in loader]) for _ in range(2))
    assert not torch.equal(first, second)  # another order
    assert torch.equal(first.sort().values, views.n_visible[rows].sort().values)
    for batch in LandmarkLoader(views, rows, 64, width=8):
        values, taken, n_visible, _, found = batch.inputs
        assert found.shape == values.shape[:2] and found.isnan().all()  # it was not asked for
        assert torch.equal(taken, n_visible.clamp(max=8)) and values.shape[1] == taken.max()
    in_order = LandmarkLoader(views, rows, len(rows), width=8)
    values, taken, *_ = next(iter(in_order)).inputs
    assert torch.equal(values[0, : taken[0]].half(), views.values[views.starts[5] : views.starts[5] + taken[0]])
    wide = next(iter(LandmarkLoader(views, rows, len(rows), 40, shuffle_seed=1))).inputs[0]
    assert torch.isfinite(wide[..., DISTANCE]).all()


NETWORKS: dict[str, type[StoredNetwork]] = {"matchability": MatchabilityNetwork, "set": SetNetwork}


def load(path: Path, method: str = "") -> TrainedNetwork[Any]:
    """What has been learnt, of the method that the file is named after unless told otherwise."""
    return TrainedNetwork.load(path, NETWORKS[method or path.stem], method or path.stem)


FEW = train_config(
    "matchability",
    "set",
    matchability=MatchabilityConfig(epochs=6, batch_size=8, learning_rate=5e-3),
    set=SetConfig(epochs=4, batch_size=32, landmarks=32),
    accelerator="cpu",
)


@pytest.fixture(scope="module")
def tracking(tmp_path_factory: pytest.TempPathFactory) -> TrackingConfig:
    return TrackingConfig(folder=str(tmp_path_factory.mktemp("mlruns")))


@pytest.fixture(scope="module")
def trained(dataset: Dataset, tracking: TrackingConfig) -> dict[str, Path]:
    models = train(dataset, FEW, tracking, progress=False)
    assert all(not model.reused for model in models)
    return {model.method: model.path for model in models}


def test_enlarged_views_are_those_of_an_enlarged_scene(dataset: Dataset) -> None:
    views = load_landmark_views(dataset, training_scenes(dataset), train_config(), 40, progress=False)
    views = replace(views, axis_height=torch.arange(len(views)).float())  # tells who is who
    rows = torch.arange(len(views))
    plain, large = (next(iter(LandmarkLoader(views, rows, len(rows), 8, 3, enlarged=by))) for by in (1.0, 4.0))
    changed = [DISTANCE, *(ATTRIBUTES.index(name) for name in ("mapped_distance", "mapped_pixel_size"))]
    same = [at for at in range(len(ATTRIBUTES)) if at not in changed]
    torch.testing.assert_close(large.inputs[0][..., same], plain.inputs[0][..., same], equal_nan=True)
    growth = (large.inputs[0] - plain.inputs[0])[..., changed]
    assert torch.allclose(growth, growth[:, :1, :1], atol=1e-5)  # one for all landmarks of a view
    growth = growth[:, 0, 0]
    assert growth.min() < -1.2 and growth.max() > 1.2 and growth.abs().max() <= np.log(4) + 1e-5
    table = pd.concat([labelled_rows(scene) for scene in training_scenes(dataset)], ignore_index=True)
    table = table.iloc[large.inputs[3].long().numpy()]
    error_m = table["error_m"].to_numpy() * growth.exp().numpy()
    good = (table["status"] == LOCALIZED) & (error_m < 0.05) & (table["error_deg"] < 0.4)
    assert np.array_equal(large.labels.numpy() > 0, good) and not torch.equal(large.labels, plain.labels)

    # and the attributes are those of the same views in a scene of twice the size
    scene = dataset.scenes[0]
    localization_map = scene.localization_map(dataset.camera)
    landmarks = localization_map.landmarks
    twice = replace(landmarks, points=2 * landmarks.points, mapping_distance_m=2 * landmarks.mapping_distance_m)
    cam_from_world = poses(labelled_rows(scene))[:20]
    visible = localization_map.landmarks_in_view(cam_from_world)
    here = LandmarkDescriber(localization_map).describe(cam_from_world, visible).values
    cam_from_world[:, :, 3] *= 2
    there = LandmarkDescriber(LocalizationMap(twice, dataset.camera)).describe(cam_from_world, visible).values
    torch.testing.assert_close(there[:, same], here[:, same], equal_nan=True, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(there[:, changed], here[:, changed] + np.log(2), rtol=1e-4, atol=1e-4)


def test_landmarks_of_enlarged_views() -> None:
    values = torch.randn(500, len(ATTRIBUTES), generator=torch.Generator().manual_seed(0))
    found = values[:, 0] > 0
    rows = torch.arange(500)
    (plain,), (large,) = (list(LandmarkBatches(values, found, rows, 500, 1, enlarged=by)) for by in (1.0, 2.0))
    growth = large.inputs[0] - plain.inputs[0]
    assert torch.equal(large.labels, plain.labels) and 0.6 < float(growth.max()) <= np.log(2) + 1e-5
    mapped = [ATTRIBUTES.index(name) for name in ("mapped_distance", "mapped_pixel_size")]
    assert torch.allclose(growth[:, [DISTANCE] * 2], growth[:, mapped], atol=1e-5)
    growth[:, [DISTANCE, *mapped]] = 0
    assert not growth.any()


@pytest.mark.parametrize(("world_size", "enlarged"), [(2, 1.0), (3, 3.0)])
def test_processes_share_out_every_batch(dataset: Dataset, world_size: int, enlarged: float) -> None:
    views = load_landmark_views(dataset, training_scenes(dataset), train_config(), 40, progress=False)
    rows = torch.arange(101)  # the last batch has one view: some processes get none
    whole = list(LandmarkLoader(views, rows, 20, width=8, shuffle_seed=3, enlarged=enlarged))
    loaders = [LandmarkLoader(views, rows, 20, 8, 3, rank, world_size, enlarged) for rank in range(world_size)]
    for batch, shares in zip(whole, zip(*loaders, strict=True), strict=True):
        assert {share.total for share in shares} == {len(batch.labels)}
        assert torch.equal(torch.cat([share.inputs[2] for share in shares]), batch.inputs[2])
        assert torch.equal(torch.cat([share.labels for share in shares]), batch.labels)
        at = 0
        for share in shares:
            values, taken = share.inputs[:2]
            for one, many in zip(values, taken, strict=True):
                assert torch.equal(one[:many], batch.inputs[0][at][:many])
                at += 1
    found = torch.rand(1000) < 0.5
    alone = [LandmarkBatches(views.values, found, torch.arange(1000), 300, 5)]
    together = [LandmarkBatches(views.values, found, torch.arange(1000), 300, 5, rank, world_size)
                for rank in range(world_size)]  # fmt: skip
    for batch, shares in zip(alone[0], zip(*together, strict=True), strict=True):
        assert torch.equal(torch.cat([share.labels for share in shares]), batch.labels)


def test_a_batch_of_one_view_or_none_is_learnt_from() -> None:
    network = SetNetwork(NO_STATISTICS, pooled=2).train()
    for n in (0, 1):
        taken = torch.full((n,), 3)
        network(torch.randn(n, 3, len(ATTRIBUTES)), taken, taken, torch.zeros(n)).sum().backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in network.parameters())


def test_maps_of_expected_scorers_can_go(dataset: Dataset, trained: dict[str, Path]) -> None:
    localization_map = dataset.split("test")[0].localization_map(CAMERA)
    scorer = make_scorer("expected-inliers", localization_map, weights=trained["matchability"])
    scorer.score(poses(dataset.split("test")[0].read_table())[:3])
    gone = weakref.ref(localization_map)
    del scorer, localization_map
    gc.collect()
    assert gone() is None


def test_who_is_found_is_learnt(dataset: Dataset, trained: dict[str, Path]) -> None:
    matchability = load(trained["matchability"])
    localization_map = dataset.split("test")[0].localization_map(CAMERA)
    described = LandmarkDescriber(localization_map).describe(poses(dataset.split("test")[0].read_table())[:50])
    probability = matchability.calibrated(matchability.network(described.values)).sigmoid().numpy()
    clear = localization_map.landmarks.ambiguity[described.rows.numpy()]
    assert probability[clear < 0.4].mean() > 0.8 and probability[clear > 0.6].mean() < 0.2


def test_the_set_network_starts_from_the_matchability(
    dataset: Dataset, trained: dict[str, Path], tracking: TrackingConfig
) -> None:
    again = train(dataset, FEW, tracking, progress=False)
    assert all(model.reused for model in again)
    record = json.loads(trained["set"].with_suffix(".json").read_text())
    assert record["about"]["matchability_sha256"] is not None
    assert record["metrics"]["val_average_precision"] > 0.8
    statistics = load(trained["matchability"]).network.statistics
    assert load(trained["set"]).network.statistics == statistics


def test_matches_must_be_stored(tmp_path: Path, tracking: TrackingConfig) -> None:
    plain = make_dataset(tmp_path)
    with pytest.raises(TableError, match="not stored which landmarks"):
        train(plain, changed(FEW, methods=("matchability",)), tracking, progress=False)


@pytest.mark.parametrize("variant", ["matchability", "set"])
def test_models_come_back_from_disk(trained: dict[str, Path], tmp_path: Path, variant: str) -> None:
    model = load(trained[variant])
    copy = tmp_path / "copy.safetensors"
    model.save(copy)
    load(copy, variant).save(tmp_path / "again.safetensors")
    assert copy.read_bytes() == (tmp_path / "again.safetensors").read_bytes()
    assert method_of_weights(copy) == variant
    for name, tensor in load(copy, variant).network.state_dict().items():
        assert torch.equal(tensor, model.network.state_dict()[name])
    tensors = load_file(copy)
    tensors.pop(sorted(tensors)[0])
    save_file(tensors, tmp_path / "broken.safetensors", metadata=_metadata(copy))
    with pytest.raises(WeightsError, match="do not fit"):
        load(tmp_path / "broken.safetensors", variant)
    other = {"matchability": "set", "set": "matchability"}[variant]
    with pytest.raises(WeightsError, match="not of"):
        load(copy, other)


def _metadata(path: Path) -> dict[str, str]:
    from safetensors import safe_open

    with safe_open(path, framework="np") as file:
        return {METADATA_KEY: file.metadata()[METADATA_KEY]}


def test_expected_scores_by_hand(dataset: Dataset, trained: dict[str, Path]) -> None:
    scene = dataset.split("test")[0]
    localization_map = scene.localization_map(CAMERA)
    views = poses(scene.read_table())[:40]
    described = LandmarkDescriber(localization_map).describe(views)
    model = load(trained["matchability"])
    p = model.calibrated(model.network(described.values)).sigmoid().double().numpy()
    starts = described.starts.numpy()
    scores = {
        name: make_scorer(name, localization_map, weights=trained["matchability"]).score(views)
        for name in ("expected-inliers", "expected-bins", "fisher-trace-expected", "fisher-mineig-expected")
    }
    fx = CAMERA.focal_px
    for view in range(40):
        part = slice(starts[view], starts[view + 1])
        assert scores["expected-inliers"][view] == pytest.approx(
            p[part].sum() / len(localization_map.landmarks), rel=1e-5
        )
        uv = described.values[part, :2].double().numpy() * fx + [CAMERA.cx, CAMERA.cy]
        cells = (uv * 30 / [CAMERA.width, CAMERA.height]).astype(int).clip(0, 29)
        none = {}
        for cell, one in zip(map(tuple, cells), p[part], strict=True):
            none[cell] = none.get(cell, 1.0) * (1 - one)
        assert scores["expected-bins"][view] == pytest.approx(
            sum(1 - one for one in none.values()) / 900, rel=1e-4, abs=1e-9
        )
        points = localization_map.landmarks.points[described.rows.numpy()[part]]
        offsets = points + views[view][:, :3].T @ views[view][:, 3]
        ratio = described.values[part, ATTRIBUTES.index("pixel_size_ratio")].double().numpy()
        weight = p[part] * (fx / 320) ** 2 / (1 + np.exp(-2 * ratio))
        numbers = (weight[:, None] * information.bearing_numbers(offsets)).sum(0)
        matrix = information.information_matrices(numbers)
        values = np.linalg.eigvalsh(matrix)
        assert scores["fisher-trace-expected"][view] == pytest.approx(values.sum(), rel=1e-4, abs=1e-6)
        assert scores["fisher-mineig-expected"][view] == pytest.approx(abs(values).min(), rel=1e-3, abs=1e-5)


def test_certain_landmarks_give_the_exact_information(dataset: Dataset, tmp_path: Path) -> None:
    """By weights that were learnt with one camera, before landmarks were told of pixels."""
    names = tuple(name for name in ATTRIBUTES if "pixel" not in name)
    network = MatchabilityNetwork(AttributeStatistics((0.0,) * len(names), (1.0,) * len(names), names))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
        network.layers[-1].bias.fill_(40.0)
    TrainedNetwork("matchability", network, CAMERA).save(tmp_path / "certain.safetensors")
    localization_map = dataset.split("test")[0].localization_map(CAMERA)
    views = poses(dataset.split("test")[0].read_table())[:60]
    for metric in ("trace", "logdet"):
        certain = make_scorer(f"fisher-{metric}-expected", localization_map, weights=tmp_path / "certain.safetensors")
        expected = certain.score(views)
        exact = make_scorer(f"fisher-{metric}-exact", localization_map).score(views)
        np.testing.assert_allclose(expected, exact, rtol=1e-3, atol=1e-4)


def test_scores_of_a_set_network(dataset: Dataset, trained: dict[str, Path]) -> None:
    scene = dataset.split("test")[0]
    localization_map = scene.localization_map(CAMERA)
    views = poses(scene.read_table())
    scorer = load_scorer(trained["set"], localization_map)
    assert isinstance(scorer, SetScorer)
    scores = scorer.score(views)
    assert scores.min() >= 0 and scores.max() <= 1 and len(np.unique(scores)) > len(scores) / 2
    order = np.random.default_rng(0).permutation(len(views))
    np.testing.assert_allclose(scorer.score(views[order]), scores[order], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(scorer.score(views[7:8]), scores[7:8], rtol=1e-4, atol=1e-6)
    narrow = localization_map.of_camera(replace(CAMERA, focal_px=2 * CAMERA.focal_px))  # it serves every camera
    assert load_scorer(trained["set"], narrow).score(views).mean() < scores.mean()
    with pytest.raises(WeightsError, match="not of a scorer"):
        load_scorer(trained["matchability"], localization_map)


def test_all_are_evaluated(dataset: Dataset, trained: dict[str, Path], tracking: TrackingConfig) -> None:
    names = ("bins", "set", "expected-inliers", "expected-bins", "fisher-logdet-expected")
    config = EvaluateConfig(methods=names, top_n=(1,), resamples=50)
    table = evaluate(dataset, config, tracking, progress=False)
    rows = table[table["scene"] == "all"].set_index("method")
    assert {"set", "expected-inliers", "expected-bins", "fisher-logdet-expected"} <= set(rows.index)
    assert rows.loc["set", "roc_auc"] > 0.8 and np.isfinite(rows.loc["set", "ece"])
    assert rows.loc["set", "reference"] == "set"


def warnings_of(scorer: Scorer, cam_from_world: Float) -> list[str]:
    """What scoring warns of, all of it of views out of range, and of this file's making."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scorer.score(cam_from_world)
    assert all(one.category is OutOfRangeWarning and one.filename == __file__ for one in caught)
    return [str(one.message) for one in caught]


@pytest.mark.parametrize("name", ["set", "expected-inliers", "fisher-trace-expected"])
def test_views_unlike_those_learnt_from(dataset: Dataset, trained: dict[str, Path], name: str) -> None:
    weights = trained["set" if name == "set" else "matchability"]
    scene = dataset.split("train")[0]
    localization_map = scene.localization_map(CAMERA)
    views = poses(scene.read_table())
    scorer = make_scorer(name, localization_map, weights=weights)
    assert scorer.in_range(views).mean() >= 0.95 and not warnings_of(scorer, views)

    landmarks = localization_map.landmarks
    far = views.copy()
    far[:, :, 3] *= 50
    farther = replace(landmarks, points=50 * landmarks.points, mapping_distance_m=50 * landmarks.mapping_distance_m)
    larger = LocalizationMap(farther, CAMERA)
    scorer = make_scorer(name, larger, weights=weights)
    sees = np.diff(larger.landmarks_in_view(far).starts) > 0
    assert np.array_equal(scorer.in_range(far), ~sees) and 0 < sees.mean() < 1
    assert not warnings_of(scorer, far[~sees])
    (text,) = warnings_of(scorer, far)
    assert text.startswith(f"{name}: {sees.sum()} of {sees.sum()} views") and "mean distance" in text
    assert not warnings_of(scorer, far)  # once

    telephoto = localization_map.of_camera(replace(CAMERA, focal_px=6 * CAMERA.focal_px))
    scorer = make_scorer(name, telephoto, weights=weights)
    assert not scorer.in_range(views).any()
    (text,) = warnings_of(scorer, views)
    assert "field of view across" in text and not warnings_of(scorer, views)


def test_older_weights_know_the_camera_of_their_views(
    dataset: Dataset, trained: dict[str, Path], tmp_path: Path
) -> None:
    tensors, header = read_weights(trained["set"])
    assert set(header.pop("range")) == {"distance_m", "in_view", "across_deg", "down_deg", "focal_px"}
    header.pop("format_version")
    write_weights(tmp_path / "old.safetensors", "set", tensors, header)
    localization_map = dataset.scenes[0].localization_map(CAMERA)
    views = poses(dataset.scenes[0].read_table())
    narrow = localization_map.of_camera(replace(CAMERA, focal_px=2 * CAMERA.focal_px))
    for seen, inside in ((localization_map, True), (narrow, False)):
        old, new = (load_scorer(path, seen) for path in (tmp_path / "old.safetensors", trained["set"]))
        assert (old.in_range(views) == inside).all() and len(warnings_of(old, views)) == 1 - inside
        np.testing.assert_array_equal(old.score(views), new.score(views))
    write_weights(tmp_path / "broken.safetensors", "set", tensors, {**header, "range": {"in_view": [1]}})
    with pytest.raises(WeightsError, match="damaged description"):
        load_scorer(tmp_path / "broken.safetensors", localization_map)


def test_the_same_seed_gives_the_same_bytes(
    dataset: Dataset, trained: dict[str, Path], tracking: TrackingConfig
) -> None:
    before = {method: path.read_bytes() for method, path in trained.items()}
    train(dataset, FEW, tracking, progress=False, force=True)
    assert {method: path.read_bytes() for method, path in trained.items()} == before


def test_few_views_are_gone_through_more_often() -> None:
    config = SetConfig()
    assert of_size(config, 200_000) is config and of_size(config, 16 * 1024) is config
    few = of_size(config, 1350)
    assert few.batch_size == 84 and few.epochs * 17 >= 600 > (few.epochs - 1) * 17
    assert of_size(config, 100).batch_size == 64 and of_size(config, 100).epochs == 300


def test_impossible_options() -> None:
    with pytest.raises(ConfigError, match="hidden names"):
        SetConfig(hidden=("colour",))
    with pytest.raises(ConfigError, match="pooled"):
        SetConfig(pooled=-1)
    with pytest.raises(ConfigError, match="width"):
        MatchabilityConfig(width=0)
    with pytest.raises(ConfigError, match="epochs"):
        SetConfig(epochs=0)
    with pytest.raises(ConfigError, match="enlarged"):
        MatchabilityConfig(enlarged=0.5)
