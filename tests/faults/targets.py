"""Readers of files by others, and whole files that fuzzing damages."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from safetensors.torch import save_file

from box_scenes import random_texture
from mapping.test_landmarks import hand_written_model, random_descriptors, write_database
from mapping.test_own_models import rig_model, written
from scenes.test_loading import MTL, OBJ, ply, textured
from synthetic_dataset import make_scene
from wheretolook.cli import parse_command
from wheretolook.dataset.viewpoint_files import has_matches, read_table, write_table
from wheretolook.geometry.camera import read_cameras
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.mapping.colmap_model import colmap_poses, model_arrays, read_model
from wheretolook.mapping.feature_files import read_descriptors
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scenes.loading import load_mesh
from wheretolook.select.waypoints import read_waypoints
from wheretolook.training.weights import METADATA_KEY, read_training, read_weights

CONFIGS = Path(__file__).parents[2] / "configs"


@dataclass(frozen=True)
class Target:
    """`make` writes whole files into a folder, `files` of them are damaged, `read` reads one."""

    make: Callable[[Path], object]
    files: tuple[str, ...]
    read: Callable[[Path], object]


def _model(text):
    def make(folder):
        written(rig_model(), folder / "rig", text)
        written(hand_written_model()[0], folder / "small", text)
        for name in ("rigs", "frames"):  # as before COLMAP 3.12
            (folder / "small" / f"{name}{'.txt' if text else '.bin'}").unlink()

    return make


def _model_files(suffix):
    files = ("cameras", "images", "points3D", "rigs", "frames")
    return tuple(f"rig/{name}{suffix}" for name in files) + tuple(f"small/{name}{suffix}" for name in files[:3])


def _read_model(path):
    model = read_model(path.parent)
    assert np.isfinite(colmap_poses(path.parent, model)).all()
    assert np.isfinite(load_colmap_landmarks(path.parent, reconstruction=model).points).all()


def _database(folder):
    model, keypoints = hand_written_model()
    write_database(folder / "a.db", model, keypoints, random_descriptors([len(points) for points in keypoints]))


def _hdf5(folder):
    import h5py

    _, keypoints = hand_written_model()
    descriptors = random_descriptors([len(points) for points in keypoints])
    with h5py.File(folder / "a.h5", "w", libver="latest") as file:
        for i, points in enumerate(keypoints):
            group = file.create_group(f"{i}.png")
            group["keypoints"] = points - 0.5
            group["descriptors"] = (descriptors[i] / 512).T.astype(np.float16)


def _read_features(path):
    model = hand_written_model()[0]
    read_descriptors(path, model, model_arrays(model))


def _landmarks(folder):
    landmarks = load_colmap_landmarks(written(hand_written_model()[0], folder / "model"))
    shutil.rmtree(folder / "model")
    landmarks.save(folder / "landmarks.npz")
    landmarks.save(folder / "compact.npz", compact=True)


def _viewpoint_map(folder):
    from planning.rooms import build, room_landmarks

    build(room_landmarks(20), directions=direction_lattice(5)).save(folder / "room")


def _read_viewpoint_map(path):
    for mmap in (True, False):
        ViewpointMap.load(path.parent, mmap).best_many([[1.0, 1.0, 1.0], [2.0, 3.0, 1.5]])


_MAP_ARRAYS = ("row_of_voxel", "directions", "ranked", "scores", "landmark_ids")
_MAP_FILES = ("room/viewpoint_map.json", *(f"room/{name}.npy" for name in _MAP_ARRAYS))


def _tables(folder):
    table = read_table(make_scene(folder / "scene", "train", 0, n_locations=2, n_directions=3, n_landmarks=10).table)
    write_table(table, folder / "a.parquet")
    write_table(table, folder / "compact.parquet", compact=True)
    rows = [np.arange(3, dtype=np.int32)] * len(table)
    write_table(table.assign(camera_id=1, matched_rows=rows, inlier_rows=rows), folder / "matches.parquet")


def _weights(folder):
    header = {"format_version": 1, "method": "set", "camera": None, "training": {"method": "set"}}
    tensors = {"a": torch.arange(3.0), "b": torch.zeros((2, 2), dtype=torch.float16)}
    save_file(tensors, folder / "a.safetensors", metadata={METADATA_KEY: json.dumps(header)})


def _read_weights(path):
    read_weights(path)
    read_training(path)


def _glb(folder):
    quad = textured(random_texture(np.random.default_rng(0), 4, 6), baseColorFactor=[128, 255, 255, 255])
    quad.export(folder / "one.glb")


def _ply(folder):
    (folder / "colors.ply").write_text(
        ply("property uchar red\nproperty uchar green\nproperty uchar blue", ["1 2 3"] * 4)
    )
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    box.export(folder / "binary.ply")


def _obj(folder):
    from PIL import Image

    (folder / "a.obj").write_text(OBJ)
    (folder / "a.mtl").write_text(MTL)
    Image.fromarray(random_texture(np.random.default_rng(0), 4, 6)).save(folder / "my texture.png")


def _settings(folder):
    shutil.copyfile(CONFIGS / "demo.yaml", folder / "demo.yaml")
    (folder / "alias.yaml").write_text("name: &a b\nscenes: {train: 1, kinds: [hall]}\nmapping: {n_images: 5}\n")


def _waypoints(folder):
    (folder / "a.csv").write_text('id,x,y,z\n"a, b",1,2,1.5\nc,-0.5,2e0,1.5\n')
    (folder / "a.tum").write_text("# t x y z\n0.5 1 2 3 0 0 0 1\n1.5 1 2 3 0 0 0 1\n")


def _cameras(folder):
    text = "# c\n1 PINHOLE 64 48 32 32 32 24\n2 OPENCV_FISHEYE 64 48 32 32 32 24 0 0 0 0\n"
    (folder / "cameras.txt").write_text(text)


TARGETS = {
    "colmap-binary": Target(_model(False), _model_files(".bin"), _read_model),
    "colmap-text": Target(_model(True), _model_files(".txt"), _read_model),
    "database": Target(_database, ("a.db",), _read_features),
    "hdf5": Target(_hdf5, ("a.h5",), _read_features),
    "landmarks": Target(_landmarks, ("landmarks.npz", "compact.npz"), Landmarks.load),
    "viewpoint-map": Target(_viewpoint_map, _MAP_FILES, _read_viewpoint_map),
    "tables": Target(
        _tables, ("a.parquet", "compact.parquet", "matches.parquet"), lambda path: read_table(path, has_matches(path))
    ),
    "weights": Target(_weights, ("a.safetensors",), _read_weights),
    "glb": Target(_glb, ("one.glb",), load_mesh),
    "ply": Target(_ply, ("colors.ply", "binary.ply"), load_mesh),
    "obj": Target(_obj, ("a.obj", "a.mtl", "my texture.png"), lambda path: load_mesh(path.with_name("a.obj"))),
    "settings": Target(
        _settings, ("demo.yaml", "alias.yaml"), lambda path: parse_command("map", ["--config", str(path)])
    ),
    "waypoints": Target(_waypoints, ("a.csv", "a.tum"), read_waypoints),
    "cameras": Target(_cameras, ("cameras.txt",), read_cameras),
}
