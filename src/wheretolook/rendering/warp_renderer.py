"""Render textured meshes with NVIDIA Warp, on CUDA or the CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, Protocol

import cv2
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import CUBE_FACES, Float, check_poses
from wheretolook.geometry.similarity import poses_from
from wheretolook.rendering.kernels import (
    TILE,
    TexturedTriangles,
    project_kernel,
    raster_kernel,
    shade_kernel,
    trace_kernel,
)
from wheretolook.rendering.raycasting import warp_mesh
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.warp import Staging, start_warp, vec3_array


@dataclass(frozen=True, eq=False)
class TexturePyramids:
    """The mip pyramids of all textures of a mesh.

    Each level is the box average of the level below it, taken of the stored sRGB values. Averaging linear light would
    be closer to a sensor, but Open3D and Habitat's unlit shader filter in sRGB too, and SIFT builds its scale space in
    it: a surface seen from afar then gives the same descriptor as the surface seen from near and blurred. It also needs
    no decoding per sample. Level l is max(1, width >> l) x max(1, height >> l).
    """

    texels: NDArray[np.uint32]  # (S,) red in the lowest byte, rows top to bottom, level by level, texture by texture
    level_start: NDArray[np.int32]  # (K, L) index in `texels` where level l of texture k starts
    size: NDArray[np.int32]  # (K, 3) width and height of level 0 and the number of levels


def build_pyramids(textures: tuple[NDArray[np.uint8], ...]) -> TexturePyramids:
    """Mip pyramids of textures (H, W, 3) uint8. Raises SceneError beyond 2^31 texels in all (8 GB)."""
    sizes = [
        [(max(1, t.shape[0] >> level), max(1, t.shape[1] >> level)) for level in range(max(t.shape[:2]).bit_length())]
        for t in textures
    ]
    n_texels = sum(height * width for levels in sizes for height, width in levels)
    if n_texels >= 2**31:
        raise SceneError(
            "the textures are too large", value=f"{n_texels} texels", fix="Downscale them below 2^31 in all"
        )
    texels = np.zeros((n_texels, 4), dtype=np.uint8)
    level_start = np.zeros((len(textures), max(map(len, sizes))), dtype=np.int32)
    start = 0
    for k, (image, levels) in enumerate(zip(textures, sizes, strict=True)):
        for level, (height, width) in enumerate(levels):
            if level > 0:
                image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
            level_start[k, level] = start
            texels[start : start + width * height, :3] = image.reshape(-1, 3)
            start += width * height
    size = np.array([(*levels[0][::-1], len(levels)) for levels in sizes], dtype=np.int32)
    return TexturePyramids(texels.view("<u4").reshape(-1).astype(np.uint32, copy=False), level_start, size)


def texel_gradients(mesh: TexturedMesh) -> NDArray[np.float32]:
    """Gradients of texel x and y by the position on each triangle, (T, 2, 3) float32 in texels per metre.

    A step of `d` metres (3,) within the plane of triangle t moves by `gradients[t] @ d` texels. Zero on triangles
    without area.
    """
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]  # (T, 2 edges, 3)
    sizes = np.array([(texture.shape[1], texture.shape[0]) for texture in mesh.textures], dtype=np.float64)
    texels = mesh.corner_uvs.astype(np.float64) * sizes[mesh.triangle_texture][:, None]
    changes = texels[:, 1:] - texels[:, :1]  # (T, 2 edges, 2)
    # The gradient g is in the plane and satisfies edges @ g = changes: g = edges^T (edges edges^T)^-1 changes.
    gram = edges @ np.swapaxes(edges, 1, 2)
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
    flat = determinant <= 1e-12 * (gram[:, 0, 0] + gram[:, 1, 1]) ** 2
    adjugate = gram[:, ::-1, ::-1] * ((1, -1), (-1, 1))  # of a symmetric matrix
    inverse = adjugate / np.where(flat, 1.0, determinant)[:, None, None]
    gradients = np.swapaxes(changes, 1, 2) @ inverse @ edges
    gradients[flat] = 0.0
    return gradients.astype(np.float32)


class Rendering:
    """Images of a batch of B poses.

    Attributes:
        rgb: (B, H, W, 3) uint8 sRGB; black where the ray through the pixel's centre meets nothing.
        depth_m: (B, H, W) float32 z-depth along the optical axis in metres; 0 where the ray meets nothing. May be given
            as a function, which copies it from a GPU when it is first used.
    """

    def __init__(
        self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32] | Callable[[], NDArray[np.float32]]
    ) -> None:
        self.rgb = rgb
        self._depth_m = depth_m

    @cached_property
    def depth_m(self) -> NDArray[np.float32]:
        return self._depth_m() if callable(self._depth_m) else self._depth_m


class Renderer(Protocol):
    """Renders a fixed mesh.

    Images are unlit, because light is baked into the textures of scanned and generated scenes: they show the texture's
    stored colour times the vertex colour, from both sides of a triangle.
    """

    def render(self, camera: Camera, cam_from_world: ArrayLike) -> Rendering:
        """Render the poses `cam_from_world` (B, 3, 4) with one camera. Raises ValueError on another shape or NaN."""
        ...


def camera_rays(camera: PinholeCamera, cam_from_world: Float) -> tuple[Float, Float]:
    """Camera centres (B, 3) and matrices (B, 3, 3) that turn a pixel (x, y, 1) into its ray's direction in the world.

    A direction has length 1 along the optical axis, so the ray parameter of a hit is its z-depth, and the first two
    columns of the matrix are the derivatives of the direction by the pixel's x and y.
    """
    rotation = np.swapaxes(cam_from_world[:, :, :3], 1, 2)
    centers = -(rotation @ cam_from_world[:, :, 3:])[..., 0]
    return centers, rotation @ np.linalg.inv(camera.matrix)


def render_distorted(renderer: Renderer, camera: ColmapCamera, cam_from_world: Float) -> Rendering:
    """What `Renderer.render` gives for poses (B, 3, 4), by looking up each pixel's ray on a cube around the camera.

    A pixel is black, and its depth 0, where the model has no ray. Depth is along the optical axis: below 0 behind it.
    """
    face, columns_rows, along = _lookup(camera)
    pinhole = _face_camera(camera)
    shape = (len(cam_from_world), camera.height, camera.width)
    rgb = np.zeros((*shape, 3), dtype=np.uint8)
    depth_m = np.zeros(shape, dtype=np.float32)
    for number in np.unique(face[face >= 0]).tolist():
        seen = renderer.render(pinhole, CUBE_FACES[number] @ cam_from_world)
        there = face == number
        (x, y) = columns_rows
        for view in range(len(cam_from_world)):
            colors = cv2.remap(seen.rgb[view], x, y, cv2.INTER_LINEAR)
            depths = cv2.remap(seen.depth_m[view], x, y, cv2.INTER_NEAREST)
            rgb[view][there] = colors[there]
            depth_m[view][there] = (depths * along)[there]
    return Rendering(rgb, depth_m)


def _face_camera(camera: ColmapCamera) -> PinholeCamera:
    focal = min(2048, np.ceil(camera.mean_focal_px))  # a camera that magnifies more is rendered less sharply
    side = int(2 * (focal + 2))  # beyond the 90 degrees of a face, 2 pixels for interpolation at its edges
    return PinholeCamera(side, side, float(focal))


@lru_cache(maxsize=8)
def _lookup(
    camera: ColmapCamera,
) -> tuple[NDArray[np.int8], tuple[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]:
    """For each pixel (H, W): face of the cube, -1 for none; column and row there; z of its ray over the face's."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
    rays = camera.unproject(pixels)
    # beyond what a model was made for, such as 90 degrees for COLMAP's fisheyes, rays come back of other pixels
    known = np.abs(camera.project(rays) - pixels).max(-1) < 0.01
    depths = np.nan_to_num(rays) @ CUBE_FACES[:, 2].T  # (H, W, 6): along the axis of each face
    face = depths.argmax(-1)
    in_face = (CUBE_FACES[face] @ np.nan_to_num(rays)[..., None])[..., 0]
    in_face[~known] = (0, 0, 1)
    at = (_face_camera(camera).project(in_face) - 0.5).astype(np.float32)  # OpenCV counts from pixel centres
    along = (np.nan_to_num(rays[..., 2]) / in_face[..., 2]).astype(np.float32)
    return np.where(known, face, -1).astype(np.int8), (at[..., 0].copy(), at[..., 1].copy()), along


Method = Literal["rays", "raster"]


def method_on(device: str) -> Method:
    """The faster method on a device."""
    return "raster" if device == "cpu" else "rays"


class WarpRenderer:
    """Renders a textured mesh: each pixel shows what the ray through its centre meets first.

    Textures are filtered over the pixel's exact footprint: trilinearly between mip levels chosen by the footprint's
    short axis, averaged over up to 8 samples along its long axis. See `TexturePyramids` for the colour space.

    The device is "cpu" (one core) or a CUDA device such as "cuda:1"; poses in `block_bytes` are rendered together. The
    method "rays" traces a ray for every pixel. "raster", on the CPU only, gives the same images up to rounding, in a
    third of the time for 640 x 480 pixels of 100,000 triangles on one core. None takes `method_on` the device. Raises
    ConfigError if there is no such device or the method does not run there, SceneError if the textures are too large
    or there is no triangle.
    """

    def __init__(
        self, mesh: TexturedMesh, device: str = "cpu", block_bytes: int = 1 << 29, method: Method | None = None
    ) -> None:
        self.device = start_warp(device)
        self.block_bytes = block_bytes
        self.method = method or method_on(self.device)
        if self.method == "raster" and self.device != "cpu":
            raise ConfigError("rasterizing runs on the CPU alone", value=device, fix='Use the method "rays".')
        if len(mesh.triangles) == 0:
            raise SceneError("there is nothing to render: the mesh has no triangle", value=0, fix="Give another mesh.")
        if self.method == "raster":
            self._vertices: Any = vec3_array(mesh.vertices, self.device)
        else:
            self._mesh = warp_mesh(mesh, self.device)
        self._appearance = self._upload(mesh)
        self._staging = Staging()
        self._origin = mesh.origin

    def _array(self, values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self.device)

    def _upload(self, mesh: TexturedMesh) -> Any:
        pyramids = build_pyramids(mesh.textures)
        colors = np.zeros((0, 3)) if mesh.vertex_colors is None else mesh.vertex_colors / 255.0
        appearance = TexturedTriangles()
        appearance.corner_uvs = self._array(mesh.corner_uvs, wp.vec2)
        appearance.texel_gradients = self._array(texel_gradients(mesh), wp.vec3)
        appearance.triangle_texture = self._array(mesh.triangle_texture, wp.int32)
        appearance.texels = self._array(pyramids.texels, wp.uint32)
        appearance.level_start = self._array(pyramids.level_start, wp.int32)
        appearance.texture_size = self._array(pyramids.size, wp.int32)
        appearance.indices = self._array(np.ascontiguousarray(mesh.triangles).reshape(-1), wp.int32)
        appearance.vertex_colors = vec3_array(colors, self.device)
        return appearance

    def render(self, camera: Camera, cam_from_world: ArrayLike) -> Rendering:
        """RGB (B, H, W, 3) and z-depth (B, H, W) of poses (B, 3, 4); see `Renderer.render`."""
        poses: Float = check_poses(cam_from_world)
        if isinstance(camera, ColmapCamera):
            return render_distorted(self, camera, poses)
        rgb = np.empty((len(poses), camera.height, camera.width, 3), dtype=np.uint8)
        depths = []
        for rows, (colors, depth) in self._blocks(camera, poses):
            rgb[rows] = self._staging.download(colors)
            depths.append(depth)

        def depth_m() -> NDArray[np.float32]:
            parts = [depth.numpy() for depth in depths]
            return np.concatenate([np.zeros((0, *rgb.shape[1:3]), dtype=np.float32), *parts])

        return Rendering(rgb, depth_m)

    def colors(self, camera: PinholeCamera, cam_from_world: ArrayLike) -> list[Any]:
        """Render poses (B, 3, 4) as Warp arrays (b, H, W) of colours, B images in all, which stay on the device."""
        colors = [images[0] for _, images in self._blocks(camera, check_poses(cam_from_world))]
        wp.synchronize_device(self.device)
        return colors

    def _blocks(self, camera: PinholeCamera, cam_from_world: Float) -> Iterator[tuple[slice, list[Any]]]:
        """Draw poses (B, 3, 4) and yield rows of poses with their colours and depths."""
        poses = poses_from(cam_from_world, self._origin)
        height = camera.height
        width = camera.width
        bytes_per_pose = height * width * 7
        if self.method == "raster":
            bytes_per_pose += height * width * 8 + self._vertices.shape[0] * 24
        block = max(1, self.block_bytes // bytes_per_pose)
        draw = self._rasterize if self.method == "raster" else self._trace
        for start in range(0, len(poses), block):
            rows = slice(start, min(start + block, len(poses)))
            shape = (rows.stop - start, height, width)
            images = [wp.empty(shape, dtype=dtype, device=self.device) for dtype in (wp.vec3ub, wp.float32)]
            centers, ray_from_pixel = camera_rays(camera, poses[rows])
            rays = (vec3_array(centers, self.device), self._array(ray_from_pixel.astype(np.float32), wp.mat33))
            draw(camera.matrix @ poses[rows], rays, images)
            yield rows, images

    # Both draw images (rgb, depth) of B poses, given (B, 3, 4) pixel_from_world and rays: centres and ray_from_pixel.

    def _trace(self, _: Float, rays: tuple[Any, Any], images: list[Any]) -> None:
        inputs = [self._mesh.id, self._appearance, *rays]
        wp.launch(trace_kernel, _tiles(images[1].shape), inputs, images, device=self.device)

    def _rasterize(self, pixel_from_world: Float, rays: tuple[Any, Any], images: list[Any]) -> None:
        shape = images[1].shape
        device = self.device
        projected: Any = wp.empty((len(pixel_from_world), self._vertices.shape[0]), dtype=wp.vec3d, device=device)
        nearness = wp.zeros(shape, dtype=wp.float32, device=device)
        triangle = wp.full(shape, -1, dtype=wp.int32, device=device)
        rotation = self._array(pixel_from_world[:, :, :3], wp.mat33d)
        offset = self._array(pixel_from_world[:, :, 3], wp.vec3d)
        wp.launch(project_kernel, projected.shape, [self._vertices, rotation, offset], [projected], device=device)
        # With a block of one, triangles are drawn one after the other.
        dim = (len(pixel_from_world), self._appearance.corner_uvs.shape[0])
        inputs = [projected, self._appearance.indices]
        wp.launch(raster_kernel, dim, inputs, [nearness, triangle], device=device, block_dim=1)
        inputs = [projected, self._vertices, triangle, self._appearance, rays[1]]
        wp.launch(shade_kernel, _tiles(shape), inputs, images, device=device)


def _tiles(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Threads of a kernel that runs tile by tile over images of a shape (B, H, W)."""
    tile = int(TILE)
    n_images, height, width = shape
    return n_images, -(-height // tile) * -(-width // tile), tile * tile
