"""Frustum tests of many directions against the landmarks each location has a free line of sight to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.geometry import Float, PinholeCamera
from wheretolook.visibility.frustum_kernel import count_kernel
from wheretolook.warp_setup import start_warp

MIN_DEPTH_M = 1e-3
"""Landmarks nearer to the image plane than this, or behind it, are not seen."""


@dataclass(frozen=True, eq=False)
class VisibleSets:
    """The landmarks each location has a free line of sight to, as rows of a sparse mask.

    Attributes:
        starts: (L + 1,) int32; row l is `indices[starts[l]:starts[l + 1]]`.
        indices: landmark rows, int32, ascending within a location.
    """

    starts: NDArray[np.int32]
    indices: NDArray[np.int32]

    @classmethod
    def from_mask(cls, mask: NDArray[np.bool_]) -> VisibleSets:
        """From a dense mask (L, N)."""
        starts = np.zeros(len(mask) + 1, dtype=np.int32)
        np.cumsum(mask.sum(1), out=starts[1:])
        return cls(starts, np.nonzero(mask)[1].astype(np.int32))


def count_in_frustum(
    camera: PinholeCamera,
    rotations: Float,
    locations: Float,
    points: Float,
    visible: VisibleSets,
    device: str = "cpu",
) -> NDArray[np.int32]:
    """Number of landmarks seen from every location in every direction (paper, Sec. 3.2).

    Args:
        camera: pinhole intrinsics.
        rotations: (D, 3, 3) cam_from_world.
        locations: (L, 3) camera centres in metres.
        points: (N, 3) landmarks in metres.
        visible: the landmarks not occluded from each location.
        device: "cpu" or a CUDA device, one thread for each location and direction.

    Returns:
        (L, D) counts.
    """
    device = start_warp(device)
    shape = (len(locations), len(rotations))
    counts = wp.zeros(shape, dtype=wp.int32, device=device)
    wp.launch(
        count_kernel,
        dim=shape,
        inputs=[
            wp.array(np.asarray(rotations, dtype=np.float32), dtype=wp.mat33, device=device),
            wp.array(np.asarray(locations, dtype=np.float32), dtype=wp.vec3, device=device),
            wp.array(np.asarray(points, dtype=np.float32), dtype=wp.vec3, device=device),
            wp.array(visible.starts, dtype=wp.int32, device=device),
            wp.array(visible.indices, dtype=wp.int32, device=device),
            float(camera.focal_px), float(camera.cx), float(camera.cy), float(camera.width), float(camera.height),
            MIN_DEPTH_M,
        ],
        outputs=[counts],
        device=device,
    )  # fmt: skip
    return counts.numpy()


def count_in_frustum_plain(
    camera: PinholeCamera, rotations: Float, locations: Float, points: Float, visible: VisibleSets
) -> NDArray[np.int32]:
    """What `count_in_frustum` computes, in NumPy."""
    counts = np.zeros((len(locations), len(rotations)), dtype=np.int32)
    for row, location in enumerate(locations):
        seen = points[visible.indices[visible.starts[row] : visible.starts[row + 1]]] - location
        in_camera = seen @ np.swapaxes(rotations, -1, -2)  # (D, n, 3)
        inside = (in_camera[..., 2] > MIN_DEPTH_M) & camera.in_image(camera.project(in_camera))
        counts[row] = inside.sum(-1)
    return counts
