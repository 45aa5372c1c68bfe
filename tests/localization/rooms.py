"""A room with known labels (its plain wall never localizes, its poster wall always does), and faulty workers.

Worker processes import this module to unpickle what the tests hand them.
"""

from __future__ import annotations

import signal
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from box_scenes import HIGH_X, LOW_X, ROOM_SIZE, box_room
from wheretolook.dataset.viewpoint_files import SCHEMA, write_table
from wheretolook.dataset.viewpoint_table import UNLABELLED, pose_columns
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.labeller import LabelTask, label_scenes
from wheretolook.localization.shard import SceneJob
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.rendered_map import build_map
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.space.free_space import FreeSpace

CAMERA = PinholeCamera(320, 240, 160.0)
PLAIN = HIGH_X
POSTER = LOW_X


@dataclass(frozen=True)
class MappedRoom:
    """A room with one plain wall, and its map."""

    mesh: Path
    landmarks: Path

    @property
    def job(self):
        return SceneJob(self.mesh, self.landmarks, CAMERA)


def map_room(folder, texture_m):
    mesh = box_room(texture_m=texture_m)
    mesh.textures[PLAIN][:] = 200
    save_glb(mesh, folder / "mesh.glb")
    mesh = load_mesh(folder / "mesh.glb")
    inputs = (mesh, WarpRenderer(mesh), FreeSpace(mesh), CAMERA, MapConfig(n_images=24))
    build_map(*inputs, seed=0, out_dir=folder / "map", raycaster=MeshRaycaster(mesh), workers=1, progress=False)
    return MappedRoom(folder / "mesh.glb", folder / "map" / "landmarks.npz")


def viewpoints(locations, directions):
    n = len(locations)
    columns = {name: np.zeros(n) for name in SCHEMA.names} | pose_columns(poses_looking_along(locations, directions))
    table = pd.DataFrame(columns).assign(viewpoint_id=np.arange(n), status=UNLABELLED, error_m=np.nan, error_deg=np.nan)
    return table.astype({"viewpoint_id": np.int64, "n_inliers": np.int32})


def facing(wall, n, distance_m, seed=0):
    """Views perpendicular to a wall x = const, so near that they see only this wall."""
    rng = np.random.default_rng(seed)
    locations = np.column_stack([np.zeros(n), rng.uniform(1.6, 2.4, n), rng.uniform(1.2, 1.4, n)])
    locations[:, 0] = ROOM_SIZE[0] - distance_m if wall == PLAIN else distance_m
    return viewpoints(locations, np.tile([1.0 if wall == PLAIN else -1.0, 0, 0], (n, 1)))


def labelled(table, room, shards, **config):
    """The table with its labels."""
    config = LabelConfig(**config)
    job = replace(room.job, store_matches=config.store_matches, appearance=config.appearance)
    (scene,) = label_scenes([LabelTask("room", job, table, shards)], config, progress=False)
    return scene.table


def label(table, room, shards, **config):
    """Bytes of the labelled table's file."""
    return file_bytes(labelled(table, room, shards, **config), shards)


def file_bytes(table, folder):
    path = folder.with_name(f"{folder.name}-labelled.parquet")
    write_table(table, path)
    return path.read_bytes()


def times(shards):
    """When each finished shard was written."""
    return {path: path.stat().st_mtime_ns for path in sorted(shards.glob("*.parquet"))}


def workers_of(pid):
    """Spawned worker processes of a process."""
    children = [child for path in Path(f"/proc/{pid}/task").glob("*/children") for child in path.read_text().split()]
    return [int(child) for child in children if "spawn_main" in _command(child)]


def is_running(pid):
    return bool(_command(pid))


def _command(pid):
    """Command line of a process; empty when it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


class Deadly:
    """Kills the worker that receives it."""

    def __reduce__(self):
        return signal.raise_signal, (signal.SIGKILL,)
