"""A picture of a scene from obliquely above, without its ceiling and the walls nearest to the eye."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, poses_looking_along, rotation_looking_along, transform
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.cutting import cut_above
from wheretolook.utils.errors import ConfigError, SceneError

FAR = 25.0
"""Distance of the eye in diagonals of the scene: so far that parallel lines stay parallel in the picture."""


@dataclass(frozen=True, eq=False)
class Dollhouse:
    """A picture of a scene on which world points can be drawn.

    Attributes:
        rgb: (H, W, 3) uint8; white where there is no surface.
        depth_m: (H, W) float32, from the eye; 0 where there is no surface.
        camera: the camera that took the picture.
        cam_from_world: (3, 4) its pose.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    camera: PinholeCamera
    cam_from_world: Float

    def pixels(self, points: ArrayLike) -> Float:
        """Pixels (..., 2) of world points (..., 3) in metres."""
        world = np.asarray(points, dtype=np.float64)
        return self.camera.project(transform(self.cam_from_world, world.reshape(-1, 3))).reshape(*world.shape[:-1], 2)

    def shows(self, points: ArrayLike, margin_m: float = 0.1) -> NDArray[np.bool_]:
        """Which world points (N, 3) in metres lie in the picture, and at most the margin behind a surface; (N,)."""
        in_camera = transform(self.cam_from_world, points)
        pixels = self.camera.project(in_camera)
        inside = self.camera.in_image(pixels)
        column, row = np.where(inside[:, None], pixels, 0).astype(int).T
        depth = self.depth_m[row, column]
        return inside & ((depth == 0) | (in_camera[:, 2] <= depth + margin_m))


def dollhouse(
    mesh: TexturedMesh,
    azimuth_deg: float = -110.0,
    elevation_deg: float = 55.0,
    cut_m: float | None = None,
    width_px: int = 1400,
    one_sided: bool = True,
    device: str = "cpu",
) -> Dollhouse:
    """Render a scene from outside.

    Args:
        mesh: metres, z up.
        azimuth_deg: direction of the eye, counter-clockwise from +x.
        elevation_deg: of the eye, in (0, 90]; 90 gives a plan with +x to the right and +y up, whatever the azimuth.
        cut_m: what lies above this world height is cut off; None keeps all.
        width_px: of the picture, whose height follows.
        one_sided: leave out triangles that turn their backs to the eye, such as ceilings and the near walls of rooms;
            for meshes that are wound reliably.
        device: "cpu" or a CUDA device.

    Raises:
        ConfigError: the elevation or width is out of range.
        SceneError: no triangle is left.
    """
    if not 0 < elevation_deg <= 90 or width_px < 2:
        raise ConfigError("the eye must be above the scene, and the picture wide", value=(elevation_deg, width_px))
    low, high = mesh.bounds
    if cut_m is not None:
        mesh = cut_above(mesh, cut_m)
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    to_eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    if elevation_deg == 90:
        to_eye = np.array([0.0, 0.0, 1.0])
    if one_sided:
        mesh = mesh.only(mesh.normals @ to_eye > 0)
    if len(mesh.triangles) == 0:
        raise SceneError("nothing of the scene is left to be seen", value=cut_m, fix="Cut higher.")
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)
    rotation = rotation_looking_along(-to_eye)
    in_eye_frame = corners @ rotation.T
    extent = np.ptp(in_eye_frame[:, :2], axis=0)
    center = (in_eye_frame.min(0) + in_eye_frame.max(0)) / 2 @ rotation
    distance = FAR * float(np.linalg.norm(high - low))
    focal_px = 0.98 * width_px * distance / extent[0]
    height_px = max(2, int(np.ceil(width_px * extent[1] / extent[0])))
    camera = PinholeCamera(width_px, height_px, float(focal_px))
    pose = poses_looking_along(center + distance * to_eye, -to_eye)
    rendering = WarpRenderer(mesh, device).render(camera, pose[None])
    rgb, depth_m = rendering.rgb[0], rendering.depth_m[0]
    rgb[depth_m == 0] = 255
    return Dollhouse(rgb, depth_m, camera, pose)
