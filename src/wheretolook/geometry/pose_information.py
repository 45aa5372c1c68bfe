"""Computes the Fisher information on a camera's pose from bearings of landmarks.

A landmark at the offset r = n f from the camera (unit bearing f, distance n) is measured as the bearing f with
isotropic noise of one radian. Let the pose be perturbed by (rho, theta), a translation and a rotation about the camera
centre, both along the world's axes. Then the landmark's information on the pose is (Zhang and Scaramuzza, Fisher
Information Field, 2020, eq. 6; here in closed form, with P = I - f f^T)

    [   P / n^2    -[f]x / n ]
    [   [f]x / n       P     ]

The camera's rotation cancels: it decides which landmarks are in view, not how much information each of them gives. Sums
over landmarks are kept as the 15 numbers that differ: P / n^2 (xx, xy, xz, yy, yz, zz), f / n (x, y, z), and
P (xx, xy, xz, yy, yz, zz).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float

N_NUMBERS = 15  # numbers that a sum of information matrices is kept as

PRIOR = 1e-3
"""Information on each coordinate of a pose without any landmark: keeps the covariance finite (1/m^2 and 1/rad^2 for a
bearing's noise of one radian)."""

PLACES = np.array([
    [0, 1, 2, 0, 8, 7],
    [1, 3, 4, 8, 0, 6],
    [2, 4, 5, 7, 6, 0],
    [0, 8, 7, 9, 10, 11],
    [8, 0, 6, 10, 12, 13],
    [7, 6, 0, 11, 13, 14],
])  # fmt: skip
SIGNS = np.array([
    [1, 1, 1, 0, 1, -1],
    [1, 1, 1, -1, 0, 1],
    [1, 1, 1, 1, -1, 0],
    [0, -1, 1, 1, 1, 1],
    [1, 0, -1, 1, 1, 1],
    [-1, 1, 0, 1, 1, 1],
])  # fmt: skip
"""Index of the number at each place of an information matrix, and its sign; 0 where none is."""


def bearing_numbers(offsets: ArrayLike) -> Float:
    """Each landmark's information as 15 numbers (..., 15), in the precision of the offsets.

    Offsets (..., 3) lead from the camera centre to the landmarks, in the world, in metres; none may be zero.
    """
    offsets = np.asarray(offsets)
    distance = np.linalg.norm(offsets, axis=-1, keepdims=True)
    bearing = offsets / distance
    across = np.eye(3, dtype=offsets.dtype) - bearing[..., :, None] * bearing[..., None, :]
    row, column = np.triu_indices(3)
    numbers = across[..., row, column]
    return np.concatenate([numbers / distance**2, bearing / distance, numbers], axis=-1)


def information_matrices(numbers: ArrayLike) -> Float:
    """Information matrices (..., 6, 6) of sums kept as numbers (..., 15); translation first, rotation second."""
    return np.asarray(numbers, dtype=np.float64)[..., PLACES] * SIGNS
