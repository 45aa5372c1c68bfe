"""Plain versions of the kernels in `wheretolook.visibility`."""

import numpy as np

from wheretolook.visibility import frustum


def count_plain(camera, rotations, locations, points, unoccluded):
    """What `FrustumCounter.count` computes, (L, D): every landmark (N, 3) is tested against every orientation."""
    rotations = np.asarray(rotations)
    points = np.asarray(points)
    counts = np.zeros((len(unoccluded), len(rotations)), dtype=np.int32)
    for row, location in enumerate(np.asarray(locations)):
        offsets = frustum.offsets_from(location, points[unoccluded[row]])
        counts[row] = frustum.in_view(camera, rotations, offsets).sum(-1)
    return counts


def count_pixels_plain(camera, rotations, locations, points, unoccluded):
    """What `PixelCounter.count` computes, (L, D): pixels with an unoccluded (L, N) landmark (N, 3)."""
    axes = np.asarray(rotations)
    positions = np.asarray(points)
    counts = np.zeros((len(unoccluded), len(axes)), dtype=np.int32)
    for row, location in enumerate(np.asarray(locations)):
        offsets = frustum.offsets_from(location, positions[unoccluded[row]])
        seen = frustum.in_view(camera, axes, offsets)
        for orientation, rotation in enumerate(axes.astype(np.float32)):
            pixels = np.floor(frustum.pixels_of(camera, frustum.rotate(rotation, offsets[seen[orientation]])))
            column, line = np.clip(pixels, 0, (camera.width - 1, camera.height - 1)).T
            counts[row, orientation] = len(np.unique(line * camera.width + column))
    return counts
