"""A room rendered from 24 places, of which nothing is known but the poses: photographs without features."""

import cv2
import numpy as np

from box_scenes import furnished_room
from colmap_models import camera, model_of
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.colmap_model import write_model
from wheretolook.rendering.warp_renderer import WarpRenderer

CAMERA = PinholeCamera(320, 240, 200.0)


def write_rendered_room(folder):
    """Write the photographs, into `photographs`, and a COLMAP model of their poses alone, into `sparse`."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    outward = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(24)])
    poses = poses_looking_along((3.0, 2.5, 1.4) - 0.9 * outward, outward)
    (folder / "photographs").mkdir()
    images = []
    for row, (pose, rgb) in enumerate(
        zip(poses, WarpRenderer(furnished_room()).render(CAMERA, poses).rgb, strict=True)
    ):
        cv2.imwrite(str(folder / "photographs" / f"{row:02}.png"), rgb[..., ::-1])
        images.append((f"{row:02}.png", 1, pose, np.zeros((0, 2))))
    write_model(model_of([camera(1, "PINHOLE", 320, 240, 200, 200, 160, 120)], images), folder / "sparse")
