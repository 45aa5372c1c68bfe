"""Ray and distance queries on a mesh with NVIDIA Warp, on CUDA or the CPU."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.rendering import ray_kernels
from wheretolook.rendering.ray_kernels import cast_kernel, clear_kernel, distance_kernel, unoccluded_kernel
from wheretolook.utils.warp import start_warp, vec3_array


@dataclass(frozen=True, eq=False)
class RayHits:
    """First hits of R rays.

    Attributes:
        distance_m: (R,) float32, from the ray's origin; infinite where nothing is hit.
        triangle: (R,) int32, the triangle hit; -1 where nothing is hit.
        front: (R,) bool, whether the triangle's front (corners counter-clockwise) was hit.
    """

    distance_m: NDArray[np.float32]
    triangle: NDArray[np.int32]
    front: NDArray[np.bool_]


class MeshRaycaster:
    """Answers ray and distance queries on a mesh.

    Args:
        mesh: the geometry; textures are not used.
        device: "cpu" (one core) or a CUDA device such as "cuda" or "cuda:1".
        block_rays: rays traced at a time in `occluded`, which bounds the memory on the device.

    Raises:
        ConfigError: if there is no such device.
    """

    def __init__(self, mesh: TexturedMesh, device: str = "cpu", block_rays: int = 1 << 28) -> None:
        self.device = start_warp(device)
        self.block_rays = block_rays
        wp.load_module(ray_kernels, device=self.device)  # only one thread may do that
        self.warp_mesh = warp_mesh(mesh, self.device)

    def occluded(self, origins: ArrayLike, points: ArrayLike, margin_m: float = 0.02) -> NDArray[np.bool_]:
        """Whether something lies between each origin and each point.

        Args:
            origins: (L, 3) metres.
            points: (N, 3) metres.
            margin_m: geometry closer to the point than this does not count, so that a landmark on (or, by its
                triangulation error, a little behind) a surface is not hidden by that surface.

        Returns:
            (L, N) bool, True where the open segment from the origin to `margin_m` before the point meets a triangle.
            Segments shorter than the margin are never occluded.
        """
        origins_at = np.asarray(origins, dtype=np.float64).reshape(-1, 3)
        points_on_device = vec3_array(points, self.device)
        n_points = points_on_device.shape[0]
        occluded = np.zeros((len(origins_at), n_points), dtype=np.bool_)
        if occluded.size == 0:
            return occluded
        threads = len(os.sched_getaffinity(0)) if self.device == "cpu" else 1
        block = max(1, min(self.block_rays // n_points, -(-len(origins_at) // threads)))

        def work(start: int) -> None:
            rows = slice(start, start + block)
            free = self.unoccluded_on_device(origins_at[rows], points_on_device, margin_m)
            occluded[rows] = ~free.numpy().astype(np.bool_)

        with ThreadPoolExecutor(threads) as pool:  # Warp lets go of Python's lock while a kernel runs
            list(pool.map(work, range(0, len(origins_at), block)))
        return occluded

    def unoccluded_on_device(self, origins: ArrayLike, points: Any, margin_m: float = 0.02) -> Any:
        """The negation of `occluded`, on the device, in one piece.

        Args:
            origins: (L, 3) metres.
            points: (N,) Warp array of vec3 on this raycaster's device.
            margin_m: as in `occluded`.

        Returns:
            (L, N) Warp array of bool, True where the line of sight is free.
        """
        origins_on_device = vec3_array(origins, self.device)
        free: Any = wp.empty((origins_on_device.shape[0], points.shape[0]), dtype=wp.bool, device=self.device)
        wp.launch(
            unoccluded_kernel,
            dim=free.shape,
            inputs=[self.warp_mesh.id, origins_on_device, points, margin_m],
            outputs=[free],
            device=self.device,
        )
        return free

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """First hit of each ray.

        Args:
            origins: (R, 3) metres.
            directions: (R, 3), need not be of unit length.

        Returns:
            Distances, triangles and sides of the R hits.
        """
        origins_on_device = vec3_array(origins, self.device)
        directions_on_device = vec3_array(directions, self.device)
        if origins_on_device.shape != directions_on_device.shape:
            raise ValueError(f"{origins_on_device.shape[0]} origins for {directions_on_device.shape[0]} directions")
        n_rays = origins_on_device.shape[0]
        distance_m = wp.empty(n_rays, dtype=wp.float32, device=self.device)
        triangle = wp.empty(n_rays, dtype=wp.int32, device=self.device)
        front = wp.empty(n_rays, dtype=wp.bool, device=self.device)
        wp.launch(
            cast_kernel,
            dim=n_rays,
            inputs=[self.warp_mesh.id, origins_on_device, directions_on_device],
            outputs=[distance_m, triangle, front],
            device=self.device,
        )
        return RayHits(distance_m.numpy(), triangle.numpy(), front.numpy().astype(np.bool_))

    def distance_to_surface(self, points: ArrayLike, max_distance_m: float) -> NDArray[np.float32]:
        """Distance from points (N, 3) to the nearest triangle, (N,) metres; infinite beyond `max_distance_m`."""
        points_on_device = vec3_array(points, self.device)
        distance_m = wp.empty(points_on_device.shape[0], dtype=wp.float32, device=self.device)
        wp.launch(
            distance_kernel,
            dim=points_on_device.shape[0],
            inputs=[self.warp_mesh.id, points_on_device, max_distance_m],
            outputs=[distance_m],
            device=self.device,
        )
        return distance_m.numpy()

    def segments_are_clear(self, a: ArrayLike, b: ArrayLike, clearance_m: float) -> NDArray[np.bool_]:
        """Whether straight segments keep a distance from the geometry.

        Args:
            a: (N, 3) metres.
            b: (N, 3) metres.
            clearance_m: least distance to any triangle along the segment. Where the segment runs parallel to a surface
                at about this distance it is tested every tenth of it, and may come closer by less than 0.2 %.

        Returns:
            (N,) bool.
        """
        starts, ends = vec3_array(a, self.device), vec3_array(b, self.device)
        if starts.shape != ends.shape:
            raise ValueError(f"{starts.shape[0]} starts for {ends.shape[0]} ends")
        clear = wp.empty(starts.shape[0], dtype=wp.bool, device=self.device)
        wp.launch(
            clear_kernel,
            dim=starts.shape[0],
            inputs=[self.warp_mesh.id, starts, ends, clearance_m],
            outputs=[clear],
            device=self.device,
        )
        return clear.numpy().astype(np.bool_)


def warp_mesh(mesh: TexturedMesh, device: str) -> wp.Mesh:
    """The mesh with its bounding volume hierarchy on a device. Warp must have been started."""
    return wp.Mesh(
        points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
        indices=wp.array(np.ascontiguousarray(mesh.triangles).reshape(-1), dtype=wp.int32, device=device),
    )
