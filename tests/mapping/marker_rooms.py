"""A textured room with markers of known size on its walls, and photographs taken in it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from box_scenes import box_room
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.rendering.warp_renderer import WarpRenderer

CAMERA = PinholeCamera(480, 360, 330.0)
DICTIONARY = "DICT_4X4_50"
_BLACK = 96  # pixels of a marker's texture: its black square, and the white around it
_MARGIN = 16


@dataclass(frozen=True)
class WallMarker:
    """A marker on a wall: the centre in metres, directions of its right and down, and the side of its black square."""

    marker_id: int
    center: tuple[float, float, float]
    right: tuple[float, float, float] = (1.0, 0.0, 0.0)
    size_m: float = 0.4

    @property
    def corners(self):
        """Corners (4, 3) of the black square, clockwise from the top left."""
        across = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * self.size_m / 2
        return np.array(self.center) + across[:, :1] * self.right + across[:, 1:] * [[0.0, 0.0, -1.0]]


MARKERS = (WallMarker(3, (1.6, 3.99, 1.5)), WallMarker(7, (2.6, 3.99, 1.0)), WallMarker(11, (3.4, 3.99, 1.7)))
"""On the wall y = 4 m, seen from inside the room."""


def marker_room(markers=MARKERS, dictionary=DICTIONARY):
    """`box_room` with markers, each on a white square. No texture repeats: a mapping would take places for one."""
    quads = []
    textures = []
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    for marker in markers:
        quads.append(marker.center + (marker.corners - marker.center)[::-1] * (1 + 2 * _MARGIN / _BLACK))
        black = cv2.aruco.generateImageMarker(kind, marker.marker_id, _BLACK)
        textures.append(np.repeat(np.pad(black, _MARGIN, constant_values=255)[..., None], 3, axis=2))
    return box_room(texture_m=5.0, more_quads=quads, more_textures=textures)


def hand_held_poses(n=14, seed=0):
    """Poses (n, 3, 4) of someone who walks along a room, looks about, and rolls the camera by a degree or so."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0, 1, n)
    positions = np.stack([1.2 + 2.6 * along, 1.3 + 0.4 * np.sin(7 * along), 1.4 + 0.2 * np.cos(9 * along)], axis=1)
    yaw = np.radians(90 + 28 * np.sin(5 * along))
    pitch = np.radians(rng.uniform(-8, 8, n))
    axes = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    poses = poses_looking_along(positions, axes)
    return rolled(poses, rng.normal(scale=1.0, size=n))


def rolled(poses, roll_deg):
    """Turn cameras about their optical axes."""
    return Rotation.from_euler("z", np.asarray(roll_deg)[:, None], degrees=True).as_matrix() @ poses


def take_photographs(mesh, poses, folder, camera=CAMERA):
    """Render photographs of poses (B, 3, 4) into a folder. Returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"photo-{index:02d}.png" for index in range(len(poses))]
    for name, rgb in zip(names, WarpRenderer(mesh).render(camera, poses).rgb, strict=True):
        cv2.imwrite(str(folder / name), rgb[..., ::-1])
    return names
