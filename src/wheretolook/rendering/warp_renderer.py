"""RGB and depth with NVIDIA Warp: traced rays on CUDA, rasterized on the CPU."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import check_poses
from wheretolook.rendering.raster_kernels import project_kernel, raster_kernel, shade_kernel
from wheretolook.rendering.raycasting import warp_mesh
from wheretolook.rendering.textures import build_pyramids, texel_gradients
from wheretolook.rendering.trace_kernel import TILE, Appearance, trace_kernel
from wheretolook.rendering.types import Rendering, camera_rays
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.warp import start_warp, vec3_array

Method = Literal["rays", "raster"]


def method_on(device: str) -> Method:
    """The faster method on a device."""
    return "raster" if device == "cpu" else "rays"


class WarpRenderer:
    """Renders a textured mesh: each pixel shows what the ray through its centre meets first.

    Textures are filtered over the pixel's exact footprint: trilinearly between mip levels chosen by the footprint's
    short axis, averaged over up to 8 samples along its long axis. See `TexturePyramids` for the colour space.

    Args:
        mesh: what to render.
        device: "cpu" (one core) or a CUDA device such as "cuda" or "cuda:1".
        block_bytes: memory that the poses rendered at a time take; a larger batch is rendered in blocks.
        method: "rays" traces a ray for every pixel; "raster" rasterizes, which gives the same images up to rounding, at
            a third of the time for 640 x 480 pixels of 100,000 triangles on one core, and runs on the CPU alone. None
            takes `method_on` the device.

    Raises:
        ConfigError: if there is no such device, or the method does not run there.
        SceneError: if the textures are too large, or there is no triangle.
    """

    def __init__(
        self,
        mesh: TexturedMesh,
        device: str = "cpu",
        block_bytes: int = 1 << 29,
        method: Method | None = None,
    ) -> None:
        self.device = start_warp(device)
        self.block_bytes = block_bytes
        self.method = method or method_on(self.device)
        if self.method == "raster" and self.device != "cpu":
            raise ConfigError("rasterizing runs on the CPU alone", value=device, fix='Use the method "rays".')
        if len(mesh.triangles) == 0:
            raise SceneError("there is nothing to render: the mesh has no triangle", value=0, fix="Give another mesh.")
        if self.method == "raster":
            self._vertices = vec3_array(mesh.vertices, self.device)
        self._mesh = warp_mesh(mesh, self.device) if self.method == "rays" else None
        self._appearance = self._upload(mesh)

    def _upload(self, mesh: TexturedMesh) -> Any:
        def upload(values: NDArray[Any], dtype: Any) -> Any:
            return wp.array(values, dtype=dtype, device=self.device)

        pyramids = build_pyramids(mesh.textures)
        colors = np.zeros((0, 3)) if mesh.vertex_colors is None else mesh.vertex_colors / 255.0
        appearance = Appearance()
        appearance.corner_uvs = upload(mesh.corner_uvs, wp.vec2)
        appearance.texel_gradients = upload(texel_gradients(mesh), wp.vec3)
        appearance.triangle_texture = upload(mesh.triangle_texture, wp.int32)
        appearance.texels = upload(pyramids.texels, wp.uint32)
        appearance.level_start = upload(pyramids.level_start, wp.int32)
        appearance.texture_size = upload(pyramids.size, wp.int32)
        appearance.indices = upload(np.ascontiguousarray(mesh.triangles).reshape(-1), wp.int32)
        appearance.vertex_colors = vec3_array(colors, self.device)
        return appearance

    def render(self, camera: PinholeCamera, cam_from_world: ArrayLike) -> Rendering:
        """Render a batch of poses.

        Args:
            camera: intrinsics shared by the batch.
            cam_from_world: (B, 3, 4) poses.

        Returns:
            RGB (B, H, W, 3) and z-depth (B, H, W), see `Rendering`.

        Raises:
            ValueError: if the poses have another shape or are not finite.
        """
        poses = check_poses(cam_from_world)
        height, width = camera.height, camera.width
        rgb = np.empty((len(poses), height, width, 3), dtype=np.uint8)
        depth_m = np.empty((len(poses), height, width), dtype=np.float32)
        per_pose = height * width * 7
        if self._mesh is None:
            per_pose += height * width * 8 + self._vertices.shape[0] * 24
        block = max(1, self.block_bytes // per_pose)
        draw = self._trace if self._mesh is not None else self._rasterize
        for start in range(0, len(poses), block):
            rows = slice(start, min(start + block, len(poses)))
            shape = (rows.stop - start, height, width)
            rgb_block = wp.empty(shape, dtype=wp.vec3ub, device=self.device)
            depth_block = wp.empty(shape, dtype=wp.float32, device=self.device)
            draw(camera, poses[rows], rgb_block, depth_block)
            rgb[rows] = rgb_block.numpy()
            depth_m[rows] = depth_block.numpy()
        return Rendering(rgb, depth_m)

    def _trace(self, camera: PinholeCamera, poses: NDArray[np.float64], rgb: Any, depth_m: Any) -> None:
        centers, ray_from_pixel = camera_rays(camera, poses)
        assert self._mesh is not None
        wp.launch(
            trace_kernel,
            dim=_tiles(depth_m),
            inputs=[
                self._mesh.id,
                self._appearance,
                vec3_array(centers, self.device),
                wp.array(ray_from_pixel.astype(np.float32), dtype=wp.mat33, device=self.device),
            ],
            outputs=[rgb, depth_m],
            device=self.device,
        )

    def _rasterize(self, camera: PinholeCamera, poses: NDArray[np.float64], rgb: Any, depth_m: Any) -> None:
        _, ray_from_pixel = camera_rays(camera, poses)
        pixel_from_world = camera.matrix @ poses  # (B, 3, 4)
        projected: Any = wp.empty((len(poses), self._vertices.shape[0]), dtype=wp.vec3d, device=self.device)
        nearness: Any = wp.zeros(depth_m.shape, dtype=wp.float32, device=self.device)
        triangle: Any = wp.full(depth_m.shape, -1, dtype=wp.int32, device=self.device)
        wp.launch(
            project_kernel,
            dim=projected.shape,
            inputs=[
                self._vertices,
                wp.array(pixel_from_world[:, :, :3], dtype=wp.mat33d, device=self.device),
                wp.array(pixel_from_world[:, :, 3], dtype=wp.vec3d, device=self.device),
            ],
            outputs=[projected],
            device=self.device,
        )
        wp.launch(
            raster_kernel,
            dim=(len(poses), self._appearance.corner_uvs.shape[0]),
            inputs=[projected, self._appearance.indices],
            outputs=[nearness, triangle],
            device=self.device,
            block_dim=1,  # triangles one after the other
        )
        wp.launch(
            shade_kernel,
            dim=_tiles(depth_m),
            inputs=[
                projected,
                self._vertices,
                triangle,
                self._appearance,
                wp.array(ray_from_pixel.astype(np.float32), dtype=wp.mat33, device=self.device),
            ],
            outputs=[rgb, depth_m],
            device=self.device,
        )


def _tiles(depth_m: Any) -> tuple[int, int, int]:
    """Threads of a kernel that runs tile by tile over images (B, H, W)."""
    tile = int(TILE)
    n_images, height, width = depth_m.shape
    return n_images, -(-height // tile) * -(-width // tile), tile * tile
