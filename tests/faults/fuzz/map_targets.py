"""Maps: COLMAP's models, databases, hloc's features, and what this package writes beside them."""

from __future__ import annotations

import shutil
import sqlite3
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from faults.fuzz.execution import Target
from mapping.test_landmarks import hand_written_model, random_descriptors, write_database
from mapping.test_own_models import rig_model, written
from wheretolook.geometry.camera import cameras_by_id
from wheretolook.mapping.colmap_files import check_binary
from wheretolook.mapping.colmap_model import (
    ModelArrays,
    camera_of_model,
    colmap_poses,
    load_mapping_poses,
    model_arrays,
    read_model,
    save_mapping_poses,
)
from wheretolook.mapping.feature_files import read_descriptors
from wheretolook.mapping.georeference import read_positions, read_scale
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.planning.viewpoint_map import ViewpointMap

_FILES = ("cameras", "images", "points3D", "rigs", "frames")


def _model(text: bool):
    def make(folder: Path) -> None:
        written(rig_model(), folder / "rig", text)
        written(hand_written_model()[0], folder / "small", text)
        for name in ("rigs", "frames"):  # as before COLMAP 3.12
            (folder / "small" / f"{name}{'.txt' if text else '.bin'}").unlink()

    return make


def _model_files(suffix: str) -> tuple[str, ...]:
    return tuple(f"rig/{name}{suffix}" for name in _FILES) + tuple(f"small/{name}{suffix}" for name in _FILES[:3])


def _read_model(path: Path) -> None:
    folder = path.parent
    model = read_model(folder)
    poses = colmap_poses(folder, model)
    assert poses.shape[1:] == (3, 4) and np.isfinite(poses).all()
    camera_of_model(model, folder, min(cameras_by_id(model.cameras, folder)))
    landmarks = load_colmap_landmarks(folder, reconstruction=model)
    assert np.isfinite(landmarks.points).all()


@cache
def _small() -> tuple[object, ModelArrays]:
    model = hand_written_model()[0]
    return model, model_arrays(model)


def _database(folder: Path) -> None:
    model, keypoints = hand_written_model()
    database = write_database(folder / "whole.db", model, keypoints, random_descriptors([len(k) for k in keypoints]))
    with sqlite3.connect(database) as source, sqlite3.connect(folder / "a.db") as target:  # what of it is read
        target.execute("PRAGMA page_size = 512")
        for table in ("images", "keypoints", "descriptors"):
            names = [row[1] for row in source.execute(f"PRAGMA table_info({table})")]
            target.execute(f"CREATE TABLE {table} ({', '.join(names)})")
            rows = source.execute(f"SELECT * FROM {table}").fetchall()
            target.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(names))})", rows)
    database.unlink()


def _hdf5(folder: Path) -> None:
    import h5py

    _, keypoints = hand_written_model()
    descriptors = random_descriptors([len(k) for k in keypoints])
    with h5py.File(folder / "a.h5", "w", libver="latest") as file:
        for i, points in enumerate(keypoints):
            group = file.create_group(f"{i}.png")
            group["keypoints"] = points - 0.5
            group["descriptors"] = (descriptors[i] / 512).T.astype(np.float16)


def _read_features(path: Path) -> None:
    model, arrays = _small()
    read_descriptors(path, "model", model, arrays)


def _arrays(folder: Path) -> None:
    landmarks = load_colmap_landmarks(written(hand_written_model()[0], folder / "model"))
    shutil.rmtree(folder / "model")
    landmarks.save(folder / "landmarks.npz")
    landmarks.save(folder / "compact.npz", compact=True)
    save_mapping_poses(np.eye(3, 4)[None], folder / "cameras.npz")


def _read_arrays(path: Path) -> None:
    if path.name == "cameras.npz":
        load_mapping_poses(path)
    else:
        Landmarks.load(path).attributes()


def _viewpoint_map(folder: Path) -> None:
    from planning.rooms import build, room_landmarks
    from wheretolook.geometry.lattices import direction_lattice

    build(room_landmarks(20), directions=direction_lattice(5)).save(folder / "room")


_MAP_ARRAYS = ("row_of_voxel", "directions", "ranked", "scores", "landmark_ids")
_MAP_FILES = ("room/viewpoint_map.json", *(f"room/{name}.npy" for name in _MAP_ARRAYS))


def _read_viewpoint_map(path: Path) -> None:
    for mmap in (True, False):  # mapped first: then no checksum keeps it from being used
        found = ViewpointMap.load(path.parent, mmap)
        found.best_many([[1.0, 1.0, 1.0], [2.0, 3.0, 1.5]])
        found.best((1.0, 1.0, 1.0))


def _reports(folder: Path) -> None:
    scale = '{"source": "markers", "factor": 2.0, "residuals": {"1": 0.5}, "unit": "percent", "marker_views": {"1": 3}}'
    (folder / "report.json").write_text(f'{{"scale": {scale}}}')
    (folder / "positions.json").write_text('{"a.png": [1, 2, 3.5], "b.png": [0, -1e2, 3]}')
    (folder / "positions.csv").write_text('image,x,y,z\na.png,1,2,3.5\n"b, c.png",0,-1e2,3\n')


def _read_report(path: Path) -> None:
    if path.name == "report.json":
        scale = read_scale(path.parent)
        if scale is not None:
            scale.describe()
    else:
        read_positions(path)


TARGETS = (
    Target("colmap-binary", _model(False), _model_files(".bin"), _read_model),
    Target("colmap-checks", _model(False), _model_files(".bin"), lambda path: check_binary(path.parent, path.parent)),
    Target("colmap-text", _model(True), _model_files(".txt"), _read_model),
    Target("database", _database, ("a.db",), _read_features),
    *([Target("hdf5", _hdf5, ("a.h5",), _read_features)] if find_spec("h5py") else []),
    Target("map-arrays", _arrays, ("landmarks.npz", "compact.npz", "cameras.npz"), _read_arrays),
    Target("map-reports", _reports, ("report.json", "positions.json", "positions.csv"), _read_report),
    Target("viewpoint-map", _viewpoint_map, _MAP_FILES, _read_viewpoint_map),
)
