"""What Open3D's viewer is given: every part of a scene, under its name, where it lies."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
import pytest

from box_scenes import furnished_room, random_triangles
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook_paper.figures.viewer import FRUSTUM_M, scene_geometries, show_scene

POSES = poses_looking_along([[1.0, 1, 1], [2, 2, 2]], [[1.0, 0, 0], [0, 1, 0]])
LANDMARKS = np.random.default_rng(0).uniform(0, 3, (20, 3))
PATH = np.array([[0.0, 0, 1], [1, 0, 1], [1, 2, 1]])


def test_everything_has_a_name_and_lies_where_it_should() -> None:
    camera = PinholeCamera(64, 48, 32.0)
    mesh = furnished_room()
    found = {one["name"]: one["geometry"] for one in scene_geometries(mesh, LANDMARKS, POSES, PATH, camera)}
    assert list(found) == [*(f"mesh {n}" for n in range(1, 6)), "landmarks", "cameras", "path"]
    assert sum(len(part.triangles) for name, part in found.items() if "mesh" in name) == len(mesh.triangles)
    np.testing.assert_allclose(np.asarray(found["landmarks"].points), LANDMARKS)
    cameras = np.asarray(found["cameras"].points)
    assert len(found["cameras"].lines) == 2 * 8
    for center, axis in zip([[1.0, 1, 1], [2, 2, 2]], [[1.0, 0, 0], [0, 1, 0]], strict=True):
        assert np.linalg.norm(cameras - center, axis=1).min() == 0
        depths = (cameras - center) @ axis
        assert np.isclose(depths, FRUSTUM_M).sum() >= 12  # four corners, each on three edges
    path = np.asarray(found["path"].points)[np.asarray(found["path"].lines)]
    np.testing.assert_allclose(path, np.stack([PATH[:-1], PATH[1:]], axis=1))


@pytest.mark.parametrize("seed", [0, 1])
def test_meshes_keep_their_textures_and_colours(seed: int) -> None:
    mesh = random_triangles(seed)
    for number, one in enumerate(scene_geometries(mesh)):
        rows = mesh.triangle_texture == number
        part = one["geometry"]
        corners = mesh.triangles[rows].reshape(-1)
        np.testing.assert_allclose(np.asarray(part.vertices), mesh.vertices[corners])
        uvs = mesh.corner_uvs[rows].reshape(-1, 2)
        np.testing.assert_allclose(
            np.asarray(part.triangle_uvs), np.column_stack([uvs[:, 0], 1 - uvs[:, 1]]), atol=1e-6
        )
        np.testing.assert_array_equal(np.asarray(one["material"].albedo_img), mesh.textures[number])
        assert part.has_vertex_colors() == (mesh.vertex_colors is not None)


def test_only_what_is_given_is_shown_and_the_ceiling_can_be_cut() -> None:
    assert [one["name"] for one in scene_geometries(landmarks=LANDMARKS)] == ["landmarks"]
    assert scene_geometries() == []
    tops = [one["geometry"].get_max_bound()[2] for one in scene_geometries(furnished_room(), cut_m=1.2)]
    assert max(tops) == pytest.approx(1.2)


def test_the_viewer_is_one_call_away(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(o3d.visualization, "draw", lambda geometries, **options: shown.append((geometries, options)))
    show_scene(landmarks=LANDMARKS, cameras=POSES, title="rooms")
    ((geometries, options),) = shown
    assert [one["name"] for one in geometries] == ["landmarks", "cameras"] and options["title"] == "rooms"
