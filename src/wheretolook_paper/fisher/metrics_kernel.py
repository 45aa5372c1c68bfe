"""Warp kernel that computes the eigenvalues of information matrices."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

vec6d = wp.types.vector(length=6, dtype=wp.float64)
mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)

ROUNDING = wp.constant(wp.float64(1e-16))
MOST_STEPS = wp.constant(200)  # about ten are needed; without a bound, the loop would not end on NaN


@wp.func
def symmetric(numbers: wp.array2d[wp.float64], row: wp.int32, first: wp.int32) -> wp.mat33d:
    """Return the symmetric matrix of xx, xy, xz, yy, yz and zz from number `first` on."""
    matrix = wp.mat33d()
    number = first
    for i in range(3):
        for j in range(i, 3):
            matrix[i, j] = numbers[row, number]
            matrix[j, i] = numbers[row, number]
            number += 1
    return matrix


@wp.func
def information_matrix(numbers: wp.array2d[wp.float64], row: wp.int32, pivot: wp.vec3d) -> mat66d:
    """As `wheretolook.geometry.pose_information.information_matrices`, of a pose that rotates about a pivot."""
    shift = symmetric(numbers, row, 0)
    cross = wp.skew(wp.vec3d(numbers[row, 6], numbers[row, 7], numbers[row, 8]))
    arm = wp.skew(pivot)
    mixed = shift * arm - cross
    turn = wp.transpose(arm) * mixed + cross * arm + symmetric(numbers, row, 9)
    matrix = mat66d()
    for i in range(3):
        for j in range(3):
            matrix[i, j] = shift[i, j]
            matrix[i, j + 3] = mixed[i, j]
            matrix[j + 3, i] = mixed[i, j]
            matrix[i + 3, j + 3] = turn[i, j]
    return matrix


@wp.func
def tridiagonal(matrix: mat66d) -> mat66d:
    """Return a tridiagonal matrix with the same eigenvalues, by Householder reflections."""
    m = matrix
    for k in range(4):
        v = vec6d()
        rest = wp.float64(0.0)
        for i in range(6):
            if i > k:
                v[i] = m[i, k]
            if i > k + 1:
                rest += m[i, k] * m[i, k]
        if rest > wp.float64(0.0):
            head = v[k + 1]
            v[k + 1] = head + wp.where(head < wp.float64(0.0), wp.float64(-1.0), wp.float64(1.0)) * wp.length(v)
            scale = wp.float64(2.0) / wp.dot(v, v)
            p = (m * v) * scale
            w = p - v * (wp.float64(0.5) * scale * wp.dot(v, p))
            m = m - wp.outer(v, w) - wp.outer(w, v)
    return m


@wp.func
def eigenvalues(matrix: mat66d) -> vec6d:
    """Return the eigenvalues of a symmetric matrix, in no order.

    The root-free implicit QL iteration of Pal, Walker and Kahan with Wilkinson's shift (Parlett, The Symmetric
    Eigenvalue Problem, Sec. 8.15), which is LAPACK's too.
    """
    m = tridiagonal(matrix)
    d = vec6d()
    squares = vec6d()  # of the elements next to the diagonal; the last is zero
    size = wp.float64(0.0)
    for i in range(6):
        d[i] = m[i, i]
        size += d[i] * d[i]
    for i in range(5):
        squares[i] = m[i + 1, i] * m[i + 1, i]
        size += wp.float64(2.0) * squares[i]
    negligible = ROUNDING * ROUNDING * size
    first = wp.int32(0)
    for _step in range(MOST_STEPS):
        last = first
        while squares[last] > negligible:
            last += 1
        if last == first:
            first += 1
            if first == 5:
                break
        else:
            root = wp.sqrt(squares[first])
            slope = (d[first + 1] - d[first]) / (wp.float64(2.0) * root)
            length = wp.sqrt(slope * slope + wp.float64(1.0))
            shift = d[first] - root / (slope + wp.where(slope < wp.float64(0.0), -length, length))
            c = wp.float64(1.0)
            s = wp.float64(0.0)
            gamma = d[last] - shift
            p = gamma * gamma
            i = last - 1
            while i >= first:
                square = squares[i]
                r = p + square
                squares[i + 1] = s * r
                c_before = c
                gamma_before = gamma
                c = p / r
                s = square / r
                gamma = c * (d[i] - shift) - s * gamma_before
                d[i + 1] = gamma_before + (d[i] - gamma)
                if c > wp.float64(0.0):
                    p = gamma * gamma / c
                else:
                    p = c_before * square
                i -= 1
            squares[first] = s * p
            d[first] = shift + gamma
    return d


@wp.kernel(enable_backward=False)
def eigenvalues_kernel(
    numbers: wp.array2d[wp.float64], pivoted: wp.bool, pivots: wp.array[wp.vec3d], values: wp.array2d[wp.float64]
):
    row = wp.tid()
    pivot = wp.vec3d()
    if pivoted:
        pivot = pivots[row]
    found = eigenvalues(information_matrix(numbers, row, pivot))
    for i in range(6):
        values[row, i] = found[i]
