"""A scene of a release is generated again from its seed, and the data of figures are those of the scene."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from synthetic_dataset import make_landmarks, make_mapping_poses
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.sampling import free_locations, sample_viewpoints
from wheretolook.dataset.viewpoint_files import write_table
from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, poses
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.mapping.colmap_model import save_mapping_poses
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.mlp.network import BinnedNetworkScorer, NetworkSpec, ViewpointNetwork
from wheretolook.space.config import FreeSpaceConfig
from wheretolook.space.free_space import FreeSpace
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.occlusion import MeshOcclusion
from wheretolook_paper.figures.overview import outcome_in_words
from wheretolook_paper.release.showcase import learning_of, open_showcase, peaks_of, pipeline_of
from wheretolook_rooms.generator import generate_apartment

CAMERA = PinholeCamera(96, 72, 48.0)
SEED = 3
APARTMENT = ApartmentConfig(n_rooms=3, area_m2=28, texels_per_m=20, texture_size=1024, light_spacing_m=0.5,
                            light_rays=4)  # fmt: skip
SAMPLING = SampleConfig(grid=(5, 4, 3), directions=40, keep=0, max_directions=12)


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """A release of one apartment whose landmarks are random points of its mesh; views up localize worse."""
    root = tmp_path_factory.mktemp("data") / "tiny"
    scene = SceneFolder(root / f"apartment-{SEED:03d}", "test", CAMERA)
    scene.map.mkdir(parents=True)
    mesh = generate_apartment(APARTMENT, SEED)
    rng = np.random.default_rng(0)
    landmarks = make_landmarks(rng, 400)
    triangles = mesh.vertices[mesh.triangles[rng.integers(0, len(mesh.triangles), 400)]].astype(np.float64)
    landmarks.points[:] = np.einsum("nc,ncd->nd", rng.dirichlet(np.ones(3), 400), triangles)
    landmarks.save(scene.landmarks)
    save_mapping_poses(make_mapping_poses(0), scene.mapping_cameras)
    space = FreeSpace(mesh)
    grid = VoxelGrid.over(space.bounds, SAMPLING.grid)
    occlusion = MeshOcclusion(MeshRaycaster(mesh), two_sided=space.two_sided)
    table, stored = sample_viewpoints(grid, free_locations(grid, space), landmarks, CAMERA, occlusion, SAMPLING)
    up = poses(table)[:, 2, 2]
    found = up < 0.5
    errors = {"error_m": np.where(found, 0.0512 + 0.1 * up, np.nan), "error_deg": np.where(found, 0.1, np.nan)}
    status = np.where(found, LOCALIZED, NO_POSE)
    write_table(
        table.assign(status=status, n_inliers=10, **errors).astype(dict.fromkeys(errors, np.float32)), scene.table
    )
    stored.save(scene.occlusion)
    dataset = Dataset(root, (scene,))
    dataset.save()
    settings = {
        "scenes": {"apartment": asdict(APARTMENT), "free_space": asdict(FreeSpaceConfig())},
        "occlusion": asdict(OcclusionConfig()),
        "sample": asdict(SAMPLING),
    }
    about = {"source": "source", "source_fingerprint": "0", "code_version": "0", "settings": settings}
    (root / "release.json").write_text(json.dumps(about))
    return dataset


@pytest.fixture(scope="module")
def showcase(release):
    return open_showcase(release)


class UpScorer(Scorer):
    """Likes level views, and those a little to the east."""

    name = "up"

    def score(self, cam_from_world):
        return 0.5 - 0.4 * cam_from_world[:, 2, 2] + 0.05 * cam_from_world[:, 2, 0]


def test_the_scene_is_the_one_that_was_sampled(showcase):
    assert showcase.name == "apartment-003" and showcase.keep == 100
    assert len(showcase.directions) == SAMPLING.directions
    assert set(showcase.table["location_id"]) <= set(showcase.free)
    centers = camera_centers(poses(showcase.table))
    np.testing.assert_allclose(showcase.grid.centers()[showcase.table["location_id"]], centers, atol=1e-9)
    assert "400 landmarks" in showcase.summary() and "12 images" in showcase.summary()


def test_another_scene_than_the_one_that_was_labelled_is_refused(release, tmp_path):
    copy = Path(shutil.copytree(release.root, tmp_path / "tiny"))
    about = json.loads((copy / "release.json").read_text())
    about["settings"]["scenes"]["apartment"]["area_m2"] = 40
    (copy / "release.json").write_text(json.dumps(about))
    with pytest.raises(SceneError):
        open_showcase(Dataset.load(copy))
    with pytest.raises(ConfigError):
        open_showcase(release, "apartment-004")


def test_pipeline_takes_the_best_views(showcase):
    scorer = UpScorer(showcase.localization_map)
    location = showcase.instructive_location()
    pipeline = pipeline_of(showcase, scorer, location)
    np.testing.assert_allclose(camera_centers(pipeline.chosen), showcase.center(location))
    rows = showcase.viewpoints(location)
    scores = scorer.score(poses(rows))
    assert pipeline.chosen_score == scores.max()
    assert pipeline.seen.sum() == rows.iloc[int(np.argmax(scores))]["n_visible"]
    # all directions are kept of so few, so that each location has the best of the lattice
    everywhere = 0.5 - 0.4 * showcase.directions[:, 2] + 0.05 * showcase.directions[:, 0]
    np.testing.assert_allclose(pipeline.best_scores, everywhere.max())
    assert pipeline.rgb.shape == (72, 96, 3) and pipeline.rgb.std() > 1


def test_peaks_are_labelled_views_with_what_came_of_them(showcase):
    scorer = UpScorer(showcase.localization_map)
    location = showcase.instructive_location()
    found = peaks_of(showcase, scorer, location, n=2)
    rows = showcase.viewpoints(location)
    axes = poses(rows)[:, 2, :3]
    scores = scorer.score(poses(rows))
    assert found.peaks[0].score == scores.max() and found.pits[0].score == scores.min()
    for view in (*found.peaks, *found.pits):
        row = int(np.argmin(np.linalg.norm(axes - view.direction, axis=1)))
        assert view.score == scores[row] and view.outcome == outcome_in_words(rows.iloc[row], brief=True)
    np.testing.assert_allclose(found.scores, scorer.score(_poses_at(showcase, location)))
    np.testing.assert_array_equal(found.tried[1], (rows["error_m"] < 0.05).to_numpy())


def test_learning_follows_the_best_and_the_worst_view(showcase):
    statistics = FeatureStatistics(("u", "v"), (48.0, 36.0), (20.0, 20.0))
    network = TrainedNetwork("mlp-2d", ViewpointNetwork(NetworkSpec(statistics, bins=6)), CAMERA)
    scorer = BinnedNetworkScorer(showcase.localization_map, network)
    location = showcase.instructive_location()
    rows = showcase.viewpoints(location)
    scores = scorer.score(poses(rows))
    for best, score in ((True, scores.max()), (False, scores.min())):
        learning = learning_of(showcase, scorer, location, best)
        assert learning.activations[-1] == pytest.approx(score)
        assert learning.channels == ("u", "v") and learning.image.counts.shape == (6, 6)
        assert learning.outcome == outcome_in_words(rows.iloc[int(np.argmin(np.abs(scores - score)))], brief=True)


def _poses_at(showcase, location):
    return poses_looking_along(np.tile(showcase.center(location), (len(showcase.directions), 1)), showcase.directions)
