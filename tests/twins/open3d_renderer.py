"""The plain reference renderer: Open3D finds the hits, NumPy looks up the colours."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import ColmapCamera
from wheretolook.geometry.poses import check_poses
from wheretolook.geometry.similarity import poses_from
from wheretolook.rendering.kernels import MAX_ANISOTROPY
from wheretolook.rendering.warp_renderer import (
    Rendering,
    build_pyramids,
    camera_rays,
    render_distorted,
    texel_gradients,
)

Float = NDArray[np.floating[Any]]


def raycasting_scene(mesh):
    """The mesh about its own origin as an `open3d.t.geometry.RaycastingScene`."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.triangles.astype(np.uint32)))
    return scene


class Open3DRenderer:
    """The twin of `WarpRenderer`, with `open3d.t.geometry.RaycastingScene` and NumPy on the CPU."""

    def __init__(self, mesh):
        self.mesh = mesh
        self._scene = raycasting_scene(mesh)
        self._pyramids = build_pyramids(mesh.textures)
        self._texel_gradients = texel_gradients(mesh)

    def render(self, camera, cam_from_world):
        """Render poses (B, 3, 4); see `Renderer.render`."""
        poses = check_poses(cam_from_world)
        if isinstance(camera, ColmapCamera):
            return render_distorted(self, camera, poses)
        poses = poses_from(poses, self.mesh.origin)
        shape = (len(poses), camera.height, camera.width)
        rgb = np.zeros((*shape, 3), np.uint8)
        depth_m = np.zeros(shape, np.float32)
        for i in range(len(poses)):
            rgb[i], depth_m[i] = self._render_one(camera, poses[i : i + 1])
        return Rendering(rgb, depth_m)

    def _render_one(self, camera, pose):
        """Image (H, W, 3) and depth (H, W) of a pose (1, 3, 4)."""
        import open3d as o3d

        (center,), (ray_from_pixel,) = camera_rays(camera, pose)
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        directions = np.stack([x, y, np.ones_like(x)], axis=-1) @ ray_from_pixel.T
        rays = np.concatenate([np.broadcast_to(center, directions.shape), directions], axis=-1)
        hits = self._scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))
        depth_m = hits["t_hit"].numpy()
        hit = np.isfinite(depth_m)

        face = hits["primitive_ids"].numpy()[hit].astype(np.int64)
        u, v = hits["primitive_uvs"].numpy()[hit].astype(np.float64).T
        weights = np.stack([1 - u - v, u, v], axis=-1)  # of the three corners
        normals = hits["primitive_normals"].numpy()[hit].astype(np.float64)
        uv = np.einsum("nc,ncd->nd", weights, self.mesh.corner_uvs[face])
        footprint = self._footprint(face, depth_m[hit], normals, directions[hit], ray_from_pixel)
        colors = self._filter(self.mesh.triangle_texture[face], uv, footprint)
        if self.mesh.vertex_colors is not None:
            corners = self.mesh.vertex_colors[self.mesh.triangles[face]]
            colors *= np.einsum("nc,ncd->nd", weights, corners / 255.0)

        rgb = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
        rgb[hit] = np.clip(np.floor(colors + 0.5), 0, 255).astype(np.uint8)
        return rgb, np.where(hit, depth_m, 0).astype(np.float32)

    def _footprint(self, face, t, normals, rays, ray_from_pixel):
        """How far a hit moves on the texture as the pixel moves by one in x and in y (columns), (N, 2, 2) texels."""
        slant = np.einsum("nd,nd->n", normals, rays)
        slant = np.where(np.abs(slant) < 1e-4, np.where(slant < 0, -1e-4, 1e-4), slant)
        by_pixel = ray_from_pixel[:, :2]  # (3, 2)
        steps = t[:, None, None] * (by_pixel - rays[:, :, None] * (normals @ by_pixel / slant[:, None])[:, None])
        return self._texel_gradients[face] @ steps

    def _filter(self, texture, uv, footprint):
        """Average of the texture over each pixel's footprint, (N, 3) in 0..255."""
        # The footprint of a round pixel is an ellipse; its axes are the left singular vectors of the footprint matrix.
        axes, lengths, _ = np.linalg.svd(footprint)
        major = lengths[:, 0]
        minor = lengths[:, 1]
        width = np.maximum(np.maximum(minor, major / MAX_ANISOTROPY), 1)
        n_taps = np.clip(np.floor(major / width + 0.5), 1, MAX_ANISOTROPY).astype(int)
        along = axes[:, :, 0] * major[:, None] / self._pyramids.size[texture, :2]
        last = self._pyramids.size[texture, 2] - 1
        level = np.minimum(np.log2(width), last)
        fine = np.floor(level).astype(int)
        blend = (level - fine)[:, None]

        colors = np.zeros((len(uv), 3))
        for tap in range(MAX_ANISOTROPY):
            on = np.flatnonzero(tap < n_taps)
            at = uv[on] + ((tap + 0.5) / n_taps[on] - 0.5)[:, None] * along[on]
            sample = (1 - blend[on]) * self._bilinear(texture[on], fine[on], at)
            sample += blend[on] * self._bilinear(texture[on], np.minimum(fine + 1, last)[on], at)
            colors[on] += sample / n_taps[on][:, None]
        return colors

    def _bilinear(self, texture, level, uv):
        """Colours (N, 3) at uv in one mip level each, the texture repeated."""
        width, height = np.maximum(1, self._pyramids.size[texture, :2] >> level[:, None]).T
        x = uv[:, 0] % 1 * width - 0.5
        y = uv[:, 1] % 1 * height - 0.5
        x0 = np.floor(x).astype(int)
        y0 = np.floor(y).astype(int)
        colors = np.zeros((len(uv), 3))
        for column, weight_x in ((x0, 1 - (x - x0)), (x0 + 1, x - x0)):
            for row, weight_y in ((y0, 1 - (y - y0)), (y0 + 1, y - y0)):
                index = self._pyramids.level_start[texture, level] + row % height * width + column % width
                texel = self._pyramids.texels[index][:, None] >> np.array([0, 8, 16], np.uint32) & 255
                colors += (weight_x * weight_y)[:, None] * texel
        return colors
