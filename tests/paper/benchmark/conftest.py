"""A scene folder in the benchmark's layout, of a generated room: drawn and mapped as the benchmark's scripts do it."""

import shutil

import cv2
import numpy as np
import pytest

from box_scenes import HIGH_X, ROOM_SIZE, box_room
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.rendered_map import plan_walk
from wheretolook.mapping.triangulation import posed_model
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.space.free_space import FreeSpace
from wheretolook_paper.benchmark.files import CAMERA, DRAWN_CAMERA, BenchmarkScene
from wheretolook_paper.benchmark.round import build_query_map

IDS = (*map(str, range(1, 13)),)  # file names sort differently: 1, 10, 11, 12, 2


def make_scene(folder):
    """00010-room: a room with one plain wall, 30 images of 320 x 320 px, 12 waypoints 0.2 m apart."""
    scene = folder / "00010-room"
    images = scene / "scene_reconstruction" / "images"
    images.mkdir(parents=True)
    mesh = box_room(texture_m=5.0)
    mesh.textures[HIGH_X][:] = 200
    save_glb(mesh, scene / "room.glb")
    mesh = load_mesh(scene / "room.glb")
    walk = plan_walk(FreeSpace(mesh), mesh.bounds, 30)
    poses = poses_looking_along(walk.positions, walk.directions)
    renderer = WarpRenderer(mesh)
    posed = posed_model(CAMERA, poses)
    for number, rgb in enumerate(renderer.render(DRAWN_CAMERA, poses).rgb, 1):
        image = posed.images[number]
        cv2.imwrite(str(images / image.name), rgb[:, :, ::-1])
        image.name = f"scene_reconstruction/images/{image.name}"  # as in the released models
    posed.write_text(str(scene / "scene_reconstruction"))
    middle = np.array(ROOM_SIZE) / 2
    at = middle + np.outer(0.2 * (np.arange(len(IDS)) - 6), (1, 0, 0))
    lines = [" ".join([name, *map(str, point)]) for name, point in zip(IDS, at.tolist(), strict=True)]
    (scene / "waypoints.txt").write_text("\n".join(lines) + "\n")
    made = folder / "made"
    made.mkdir()
    build_query_map(BenchmarkScene.of(scene), renderer, made, 1, "cpu")
    for path in (scene / "scene_reconstruction").glob("*.txt"):
        path.unlink()
    for path in made.glob("*.bin"):
        shutil.copy(path, scene / "scene_reconstruction")
    return scene


@pytest.fixture(scope="session")
def scene_folder(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("benchmark"))
