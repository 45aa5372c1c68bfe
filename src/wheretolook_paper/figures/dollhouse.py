"""Render a scene from obliquely above, without ceiling and near walls, and draw world points on the image."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh, cut_above
from wheretolook.geometry.poses import Float, poses_looking_along, rotation_looking_along, transform
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.utils.errors import SceneError


@dataclass(frozen=True, eq=False)
class Dollhouse:
    """Image of a scene from outside, with the camera and pose that project world points onto it."""

    rgb: NDArray[np.uint8]  # (H, W, 3); white without a surface
    depth_m: NDArray[np.float32]  # (H, W), from the eye; 0 without a surface
    camera: PinholeCamera
    cam_from_world: Float  # (3, 4)

    def pixels(self, points: ArrayLike) -> Float:
        """Project world points (..., 3) m to pixels (..., 2)."""
        world = np.asarray(points, dtype=np.float64)
        return self.camera.project(transform(self.cam_from_world, world.reshape(-1, 3))).reshape(*world.shape[:-1], 2)

    def shows(self, points: ArrayLike, margin_m: float = 0.1) -> NDArray[np.bool_]:
        """Test which world points (N, 3) m are on a visible surface of the image, within a margin; (N,).

        Points on hidden or removed surfaces are not.
        """
        in_camera = transform(self.cam_from_world, points)
        pixels = self.camera.project(in_camera)
        inside = self.camera.in_image(pixels)
        column, row = np.where(inside[:, None], pixels, 0).astype(int).T
        depth = self.depth_m[row, column]
        return inside & (np.abs(in_camera[:, 2] - depth) <= margin_m)


def dollhouse(
    mesh: TexturedMesh,
    elevation_deg: float = 55.0,
    cut_m: float | None = None,
    width_px: int = 1400,
    one_sided: bool = True,
    device: str = "cpu",
) -> Dollhouse:
    """Render a scene from outside.

    Args:
        mesh: the scene.
        elevation_deg: of the eye, in (0, 90]; 90 gives a plan with +x to the right and +y up.
        cut_m: world height above which the mesh is cut off.
        width_px: width of the image.
        one_sided: leave out triangles that face away from the eye, such as ceilings; needs consistent winding.
        device: where to render.

    Raises SceneError if no triangle remains.
    """
    bounds = mesh.bounds
    if cut_m is not None:
        mesh = cut_above(mesh, cut_m)
    azimuth = np.radians(-110.0)  # direction of the eye, counter-clockwise from +x
    elevation = np.radians(elevation_deg)
    level = np.cos(elevation) if elevation_deg < 90 else 0.0
    to_eye = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    if one_sided:
        mesh = mesh.only(mesh.normals @ to_eye > 0)
    if len(mesh.triangles) == 0:
        raise SceneError("no triangle of the scene is visible", value=cut_m, fix="Cut higher.")
    corners = np.array(list(product(*bounds.T)))
    rotation = rotation_looking_along(-to_eye)
    in_eye_frame = corners @ rotation.T
    extent = np.ptp(in_eye_frame[:, :2], axis=0)
    center = (in_eye_frame.min(0) + in_eye_frame.max(0)) / 2 @ rotation
    # so many diagonals of the scene away, the projection is close to an orthographic one
    distance = 25.0 * float(np.linalg.norm(np.ptp(bounds, axis=0)))
    focal_px = 0.98 * width_px * distance / extent[0]
    height_px = max(2, int(np.ceil(width_px * extent[1] / extent[0])))
    camera = PinholeCamera(width_px, height_px, float(focal_px))
    pose = poses_looking_along(center + distance * to_eye, -to_eye)
    rendering = WarpRenderer(mesh, device).render(camera, pose[None])
    rendering.rgb[rendering.depth_m == 0] = 255
    return Dollhouse(rendering.rgb[0], rendering.depth_m[0], camera, pose)


def draw_house(axes: Axes, house: Dollhouse, fade: float = 0.5) -> None:
    """Draw the image with axes in its pixels; `fade` blends it with white, from 0 (unchanged) to 1 (white)."""
    height, width = house.rgb.shape[:2]
    rgb = 255 * (house.rgb / 255.0) ** 0.7  # brightens rooms without lamps
    axes.imshow((rgb + fade * (255 - rgb)).astype(np.uint8), extent=(0, width, height, 0))
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
    axes.axis("off")


def draw_points(axes: Axes, house: Dollhouse, points: ArrayLike, **style: Any) -> None:
    """Draw world points (N, 3) m as dots."""
    pixels = house.pixels(points).reshape(-1, 2)
    axes.scatter(pixels[:, 0], pixels[:, 1], **{"linewidths": 0, **style})


def draw_segments(axes: Axes, house: Dollhouse, segments: ArrayLike, **style: Any) -> LineCollection:
    """Draw lines between pairs of world points (..., 2, 3) m."""
    pixels = house.pixels(np.asarray(segments)).reshape(-1, 2, 2)
    lines = LineCollection(list(pixels), **{"capstyle": "round", **style})
    axes.add_collection(lines, autolim=False)
    return lines
