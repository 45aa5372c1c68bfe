"""Shared fixtures: small random maps and views, and an MLflow store that is quick to make."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch
import warp as wp
from matplotlib.figure import Figure

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.localization import labeller
from wheretolook.localization.shard import ShardWorker
from wheretolook.tracking import TrackingConfig, client
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.frustum import LandmarkSets

LONG = [f"test_{name}.py" for name in ("pipeline", "release", "notebooks", "evaluate", "train", "engines", "faults")]
"""Files that take longest. They are begun first, so that no process is left with one when the others have finished."""


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: LONG.index(item.path.name) if item.path.name in LONG else len(LONG))


def pytest_generate_tests(metafunc):
    """Tests that take a device run on the CPU, and on CUDA where there is one."""
    if "device" in metafunc.fixturenames:
        start_warp()
        metafunc.parametrize("device", ["cpu", "cuda"] if wp.is_cuda_available() else ["cpu"])


@pytest.fixture(scope="session", autouse=True)
def migrated_stores(tmp_path_factory):
    """New MLflow stores start as a copy of an empty one, since MLflow takes seconds to make a store's tables."""
    empty = TrackingConfig(str(tmp_path_factory.mktemp("mlruns")))
    made_by_mlflow = TrackingConfig.uri.fget

    def uri(tracking):
        store = tracking.root / "mlflow.db"
        if tracking != empty and not store.exists():
            if not (empty.root / store.name).exists():
                client(empty)
            store.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(empty.root / store.name, store)
        return str(made_by_mlflow(tracking))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrackingConfig, "uri", property(uri))
        yield


def _without_pictures():
    """Figures are built, but their files stay empty: drawing is a third of a small training or evaluation."""

    def savefig(figure, file, **options):
        file.write(b"")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", savefig)
        yield


no_pictures = pytest.fixture(_without_pictures, scope="module", name="no_pictures")
no_pictures_here = pytest.fixture(_without_pictures, name="no_pictures_here")


@pytest.fixture
def in_this_process(monkeypatch):
    """Shards are labelled here one after the other: quicker, for what the workers have no part in."""
    threads = torch.get_num_threads(), cv2.getNumThreads()

    def run(shards, workers):
        worker = ShardWorker()
        for shard in shards:
            yield shard, worker.label(shard.job, shard.rows)

    monkeypatch.setattr(labeller, "run_local", run)
    yield
    torch.set_num_threads(threads[0])
    cv2.setNumThreads(threads[1])


@dataclass(frozen=True)
class RandomViews:
    """Views from a few locations at random landmarks, some of them occluded at random."""

    camera: PinholeCamera
    points: Float
    locations: Float
    directions: Float
    mask: np.ndarray
    visible: LandmarkSets
    location_rows: np.ndarray
    cam_from_world: Float


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(params=[0, 1, 2])
def random_views(request):
    rng = np.random.default_rng(request.param)
    camera = PinholeCamera(320, 200 + 20 * request.param, 150.0 + 30 * request.param)
    points = rng.uniform(-4, 4, (800, 3))
    locations = rng.uniform(-2, 2, (5, 3))
    directions = rng.normal(size=(17, 3))
    mask = rng.random((len(locations), len(points))) < 0.6
    location_rows = rng.integers(0, len(locations), 40)
    poses = poses_looking_along(locations[location_rows], rng.normal(size=(40, 3)))
    return RandomViews(camera, points, locations, directions, mask, LandmarkSets.from_mask(mask), location_rows, poses)
