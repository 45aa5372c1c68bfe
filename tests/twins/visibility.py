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
