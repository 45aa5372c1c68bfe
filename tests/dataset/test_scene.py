"""Scenes of a dataset and of a COLMAP model."""

from pathlib import Path

import pytest

from box_scenes import furnished_room
from planning.rooms import CAMERA, room_landmarks
from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.geometry.lattices import ViewLattice
from wheretolook.rendering import raycasting
from wheretolook.scenes.loading import save_glb
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import write_json
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import CachedOcclusion


@pytest.fixture
def files(tmp_path):
    files = SceneFolder(tmp_path / "room", "test")
    files.map.mkdir(parents=True)
    save_glb(furnished_room(), files.mesh)
    room_landmarks(50).save(files.landmarks)
    return files


def test_parts_of_a_scene_share_one_ray_caster(files, monkeypatch):
    built = []
    build = raycasting.MeshRaycaster.__init__
    monkeypatch.setattr(raycasting.MeshRaycaster, "__init__", lambda *args: built.append(args) or build(*args))
    scene = Scene(files, CAMERA)
    grid, free = scene.free_voxels(ViewLattice((5, 4, 3), directions=10), scene.space)
    assert 0 < len(free) < len(grid) and scene.space is scene.sampled_space
    assert scene.localization_map.occlusion is scene.occlusion and scene.localization_map.camera == CAMERA
    assert len(built) == 1


def test_without_a_mesh_landmarks_hide_one_another_and_a_unit_is_needed(files):
    files.mesh.unlink()
    with pytest.raises(ConfigError):
        _ = Scene(files, CAMERA).occlusion
    write_json(files.map / "report.json", {"scale": {"source": "unknown"}})
    scene = Scene(files, CAMERA)
    assert scene.is_photographed and isinstance(scene.occlusion, HiddenPointRemoval)
    none = OcclusionConfig(model="none")
    assert Scene(files, CAMERA, none).occlusion_config.model == "none"
    with pytest.raises(MapError):
        _ = scene.space
    write_json(files.map / "report.json", {"scale": {"source": "unknown", "factor": 0.3}})  # scaled by its depth
    assert Scene(files, CAMERA).frame.doubts


@pytest.mark.parametrize(
    ("occlusion", "mesh", "depth"), [("mesh", None, None), ("tsdf", "m", None), ("x", None, None), ("", "m", "d")]
)
def test_an_occlusion_model_needs_its_files(occlusion, mesh, depth):
    with pytest.raises(ConfigError):
        files = ColmapFiles(Path("sparse"), mesh=mesh and Path(mesh), depth=depth and Path(depth))
        Scene.of_colmap(files, occlusion_name=occlusion)


def test_the_most_accurate_occlusion_model_is_the_default(files):
    by_mesh = Scene.of_colmap(ColmapFiles(Path("sparse"), mesh=files.mesh))
    assert by_mesh.available_occlusion == ("mesh", "hidden-points", "none") and by_mesh.occlusion_config.model == "mesh"
    assert isinstance(Scene.of_colmap(ColmapFiles(Path("sparse"))).occlusion, HiddenPointRemoval)
    cached = Scene.of_colmap(ColmapFiles(Path("sparse")), cache_bytes=1 << 20)
    assert isinstance(cached.occlusion, CachedOcclusion)


@pytest.mark.parametrize("options", [{"grid": (8, 0, 8)}, {"directions": 0}, {"lattice": "spiral"}])
def test_invalid_lattices(options):
    with pytest.raises(ConfigError):
        ViewLattice(**options)
