"""Plain versions of the Fisher information kernels."""

import numpy as np

from wheretolook.geometry import pose_information
from wheretolook.geometry.pose_information import N_NUMBERS, bearing_numbers
from wheretolook.visibility.frustum import offsets_from
from wheretolook_paper.fisher.field import NEAREST_M


def information_matrices(numbers, pivots=None):
    """`pose_information.information_matrices` (..., 6, 6) of a pose that is rotated about pivots.

    These are offsets (..., 3) m from the camera centre; None for the centre itself.
    """
    matrices = pose_information.information_matrices(numbers)
    if pivots is None:
        return matrices
    turn = np.broadcast_to(np.eye(6), matrices.shape).copy()  # the centre moves by theta x (centre - pivot)
    turn[..., :3, 3:] = np.cross(np.eye(3), np.asarray(pivots, dtype=np.float64)[..., None, :])
    return np.asarray(np.swapaxes(turn, -1, -2) @ matrices @ turn)


def field_sums_plain(locations, points, visibility, unoccluded=None):
    """What `field_sums` computes, in NumPy and double precision."""
    result = np.empty((len(locations), visibility.n_factors, N_NUMBERS))
    for row, location in enumerate(locations):
        offsets = offsets_from(location, points if unoccluded is None else points[unoccluded[row]]).astype(np.float64)
        distance = np.linalg.norm(offsets, axis=1, keepdims=True)
        kept = distance[:, 0] > NEAREST_M
        bearings = offsets[kept] / distance[kept]
        result[row] = visibility.of_bearings(bearings).T @ bearing_numbers(offsets[kept])
    return result


def eigenvalues_plain(numbers, pivots=None):
    """What `eigenvalues` computes, in NumPy, ascending."""
    return np.asarray(np.linalg.eigvalsh(information_matrices(numbers, pivots)))
