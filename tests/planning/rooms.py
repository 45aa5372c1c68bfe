"""Viewpoint maps of a room with a cabinet in it, which hides landmarks from some voxels."""

from dataclasses import replace
from functools import cache
from typing import TypeVar

import numpy as np

from box_scenes import ROOM, furnished_room
from synthetic_dataset import make_landmarks
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, direction_lattice
from wheretolook.geometry.similarity import Similarity
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scenes.loading import save_glb
from wheretolook.scorers.registry import make_scorer
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import PlanningError
from wheretolook.utils.files import write_json
from wheretolook.visibility.occlusion import MeshOcclusion

CAMERA = PinholeCamera(160, 120, 80.0)
GRID = VoxelGrid((0.0, 0.0, 0.0), ROOM, (5, 4, 3))
DIRECTIONS = direction_lattice(60)
TURNED = Similarity(0.1, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.3, -0.2, 0.1]))
"""World from a map with y down, of 0.1 m units."""


T = TypeVar("T")


def patiently(plan, seconds=0.6):
    """Plan in the time that an idle machine needs; on a busy one, retry with much more."""
    for times in (1, 8):
        try:
            return plan(times * seconds)
        except PlanningError:
            pass
    return plan(40 * seconds)


def room_landmarks(n, seed=0):
    """Return landmarks on the room's walls with random attributes; the cabinet occludes some."""
    rng = np.random.default_rng(seed)
    landmarks = make_landmarks(rng, n)
    points = rng.uniform(0, ROOM, (n, 3))
    wall = rng.integers(0, 2, n)
    points[np.arange(n), wall] = np.array(ROOM)[wall] * rng.integers(0, 2, n)
    return replace(landmarks, points=points)


@cache
def occlusion():
    """Return occlusion by the room's mesh."""
    return MeshOcclusion(MeshRaycaster(furnished_room(), "cpu"))


@cache
def free_voxels():
    """Return ids of the voxels where a camera can be."""
    free = FreeSpace(furnished_room()).is_free(GRID.centers())
    return tuple(np.flatnonzero(free).tolist())


def room_map(landmarks, model=None):
    """Return the localization map of the room."""
    return LocalizationMap(Map(landmarks), CAMERA, model or occlusion())


def build(landmarks, method="bins", directions=DIRECTIONS):
    """Return the viewpoint map of the room."""
    return build_viewpoint_map(make_scorer(method, room_map(landmarks)), GRID, free_voxels(), directions, "fibonacci")


def write_room_dataset(folder, landmarks, camera=CAMERA, names="a"):
    """Write dataset `folder`/data/rooms of furnished rooms with landmarks, as the map command leaves it."""
    scenes = tuple(SceneFolder(folder / "data" / "rooms" / name, "test", camera) for name in names)
    for scene in scenes:
        scene.map.mkdir(parents=True)
        save_glb(furnished_room(), scene.mesh)
        landmarks.save(scene.landmarks)
        write_json(scene.folder / "stages.json", {"scenes": "x", "map": "y"})
    Dataset(folder / "data" / "rooms", scenes).save()
