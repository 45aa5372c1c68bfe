"""Ray-traced RGB and depth with NVIDIA Warp: one kernel for CUDA and the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry import PinholeCamera
from wheretolook.rendering.render_kernel import TILE, Appearance, render_kernel
from wheretolook.rendering.textures import build_pyramids, texel_gradients
from wheretolook.rendering.types import Rendering, camera_rays, check_poses
from wheretolook.scenes.mesh import TexturedMesh
from wheretolook.warp_setup import start_warp, vec3_array, warp_mesh


class WarpRenderer:
    """Renders a textured mesh with one ray through each pixel's centre.

    Textures are filtered over the pixel's exact footprint: trilinearly between mip levels chosen by the footprint's
    short axis, averaged over up to 8 samples along its long axis. See `TexturePyramids` for the colour space.

    Args:
        mesh: what to render.
        device: "cpu" (one core) or a CUDA device such as "cuda" or "cuda:1".
        block_bytes: image memory rendered at a time; a larger batch is rendered in blocks.

    Raises:
        ConfigError: if there is no such device.
        SceneError: if the textures are too large.
    """

    def __init__(self, mesh: TexturedMesh, device: str = "cpu", block_bytes: int = 1 << 29) -> None:
        self.device = start_warp(device)
        self.block_bytes = block_bytes
        self.warp_mesh = warp_mesh(mesh, self.device)
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
        appearance.indices = self.warp_mesh.indices
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
        centers, ray_from_pixel = camera_rays(camera, poses)
        tile = int(TILE)
        tiles = -(-height // tile) * -(-width // tile)
        block = max(1, self.block_bytes // (height * width * 7))
        for start in range(0, len(poses), block):
            stop = min(start + block, len(poses))
            rgb_block = wp.empty((stop - start, height, width), dtype=wp.vec3ub, device=self.device)
            depth_block = wp.empty((stop - start, height, width), dtype=wp.float32, device=self.device)
            wp.launch(
                render_kernel,
                dim=(stop - start, tiles, tile * tile),
                inputs=[
                    self.warp_mesh.id,
                    self._appearance,
                    vec3_array(centers[start:stop], self.device),
                    wp.array(ray_from_pixel[start:stop].astype(np.float32), dtype=wp.mat33, device=self.device),
                ],
                outputs=[rgb_block, depth_block],
                device=self.device,
            )
            rgb[start:stop] = rgb_block.numpy()
            depth_m[start:stop] = depth_block.numpy()
        return Rendering(rgb, depth_m)
