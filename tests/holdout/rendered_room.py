"""A room rendered from 24 places, of which nothing is known but the poses: photographs without features."""

import cv2
import numpy as np
import pycolmap

from box_scenes import furnished_room
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.rendering.warp_renderer import WarpRenderer


def write_rendered_room(folder):
    """Write the photographs, into `photographs`, and a COLMAP model of their poses alone, into `sparse`."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    outward = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(24)])
    poses = poses_looking_along((3.0, 2.5, 1.4) - 0.9 * outward, outward)
    camera = PinholeCamera(320, 240, 200.0)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **camera.colmap.record()))
    (folder / "photographs").mkdir()
    for row, (pose, rgb) in enumerate(
        zip(poses, WarpRenderer(furnished_room()).render(camera, poses).rgb, strict=True)
    ):
        cv2.imwrite(str(folder / "photographs" / f"{row:02}.png"), rgb[..., ::-1])
        image = pycolmap.Image(name=f"{row:02}.png", camera_id=1, image_id=row + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    (folder / "sparse").mkdir()
    model.write_binary(str(folder / "sparse"))
