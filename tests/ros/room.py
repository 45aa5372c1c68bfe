"""A textured room, and the robot's folder of its map: landmarks on what six square images see of it, without overlap."""

from pathlib import Path

import cv2
import numpy as np

from box_scenes import box_quads, quads_mesh
from wheretolook import load_scorer
from wheretolook.features.extractor import quantize_descriptors
from wheretolook.features.opencv_sift import RootSift
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.looks.next_look import mean_scores_by_pitch
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.robot.export import export_localizer, export_robot

CENTER = np.array((3.0, 2.5, 1.2))
WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights" / "set.safetensors"
DIRECTIONS = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
CUBE = PinholeCamera(640, 640, 320.0)
REC_709 = (0.2126, 0.7152, 0.0722)


def room_mesh():
    """A room of 6 x 5 x 3 m with another texture on each side."""
    rng = np.random.default_rng(3)
    textures = []
    for _ in range(6):
        layers = [cv2.resize(rng.random((n, n, 3)), (768, 768), interpolation=cv2.INTER_CUBIC) for n in (24, 60, 150)]
        textures.append(np.asarray(np.clip(255 * np.mean(layers, axis=0), 0, 255), dtype=np.uint8))
    return quads_mesh(box_quads((0, 0, 0), (6, 5, 3), inward=True), textures)


def room_landmarks(mesh):
    """Keypoints of the six images as landmarks at their depth."""
    poses = poses_looking_along(np.tile(CENTER, (6, 1)), DIRECTIONS)
    rendered = WarpRenderer(mesh).render(CUBE, poses)
    points = []
    descriptors = []
    for pose, rgb, depth in zip(poses, rendered.rgb, rendered.depth_m, strict=True):
        keypoints = RootSift().extract((rgb @ REC_709).astype(np.uint8))
        x, y = keypoints.pixels.astype(int).T
        rays = CUBE.unproject(keypoints.pixels)
        in_camera = rays / rays[:, 2:] * np.asarray(depth)[y, x, None]
        points.append((in_camera - pose[:, 3]) @ pose[:, :3])
        descriptors.append(quantize_descriptors(keypoints.descriptors))
    at = np.concatenate(points)
    n = len(at)
    offset = at - CENTER
    distance = np.linalg.norm(offset, axis=1)
    ones = np.ones(n, dtype=np.float32)
    return Landmarks(
        ids=np.arange(n),
        points=at,
        track_length=np.full(n, 5, dtype=np.int32),
        reprojection_error_px=0.3 * ones,
        triangulation_angle_deg=15 * ones,
        mapping_direction=(offset / distance[:, None]).astype(np.float32),
        mapping_direction_spread=0.02 * ones,
        mapping_distance_m=distance.astype(np.float32),
        mapping_distance_spread=0.1 * ones,
        descriptors=np.concatenate(descriptors),
        ambiguity=0.5 * ones,
        mapping_focal_px=320 * ones,
    )


def write_folder(mesh, folder, places=None):
    """Export the robot's folder, with the occlusion at places (L, 3) m."""
    landmarks = room_landmarks(mesh)
    source = LocalizationMap(Map(landmarks), PinholeCamera())
    export_localizer(landmarks, landmarks.ids, mean_scores_by_pitch(load_scorer(source), CENTER[None]), folder)
    return export_robot(source, WEIGHTS, folder, places, progress=False)
