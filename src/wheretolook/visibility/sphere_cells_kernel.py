"""Warp functions and kernels that find the cell of a direction, and the cells inside and on the border of a view."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

INSIDE = wp.constant(1)
BORDER = wp.constant(2)


@wp.func
def sign_of(x: wp.float32) -> wp.float32:
    return wp.where(x >= 0.0, 1.0, -1.0)


@wp.func
def cell_of(direction: wp.vec3, size: wp.int32) -> wp.int32:
    """Cell of a direction of any length but zero, on the octahedral map of size x size cells."""
    scale = 1.0 / (wp.abs(direction[0]) + wp.abs(direction[1]) + wp.abs(direction[2]))
    u = direction[0] * scale
    v = direction[1] * scale
    if direction[2] < 0.0:
        folded = (1.0 - wp.abs(v)) * sign_of(u)
        v = (1.0 - wp.abs(u)) * sign_of(v)
        u = folded
    half = 0.5 * wp.float32(size)
    column = wp.clamp(wp.int32((u + 1.0) * half), 0, size - 1)
    row = wp.clamp(wp.int32((v + 1.0) * half), 0, size - 1)
    return row * size + column


@wp.kernel
def classify_pinhole_kernel(
    sides: wp.array2d[wp.vec3],
    corners: wp.array[wp.vec3],
    size: wp.int32,
    margin: wp.float32,
    classes: wp.array2d[wp.uint8],
):
    orientation, cell = wp.tid()
    row = cell / size
    corner = row * (size + 1) + cell - row * size
    inside = wp.bool(True)
    outside = wp.bool(False)
    for side in range(4):
        normal = sides[orientation, side]
        a = wp.dot(normal, corners[corner])
        b = wp.dot(normal, corners[corner + 1])
        c = wp.dot(normal, corners[corner + size + 1])
        d = wp.dot(normal, corners[corner + size + 2])
        if not (wp.min(wp.min(a, b), wp.min(c, d)) >= margin):
            inside = False
        if wp.max(wp.max(a, b), wp.max(c, d)) < -margin:
            outside = True
    kind = wp.uint8(BORDER)
    if outside:
        kind = wp.uint8(0)
    elif inside:
        kind = wp.uint8(INSIDE)
    classes[orientation, cell] = kind


@wp.kernel
def classify_field_kernel(
    rotations: wp.array[wp.mat33],
    centers: wp.array[wp.vec3],
    depth: wp.array[wp.float32],
    field_size: wp.int32,
    margin: wp.float32,
    classes: wp.array2d[wp.uint8],
):
    orientation, cell = wp.tid()
    inside_by = depth[cell_of(rotations[orientation] * centers[cell], field_size)]
    kind = wp.uint8(BORDER)
    if inside_by > margin:
        kind = wp.uint8(INSIDE)
    elif inside_by < -margin:
        kind = wp.uint8(0)
    classes[orientation, cell] = kind


@wp.kernel
def runs_kernel(
    classes: wp.array2d[wp.uint8],
    size: wp.int32,
    wanted: wp.int32,
    write: wp.bool,
    starts: wp.array[wp.int32],
    numbers: wp.array[wp.int32],
    cells: wp.array[wp.vec2i],
):
    """Count the runs of cells of a class in each row of the map and, with `write`, list them from `starts` on."""
    orientation, row = wp.tid()
    index = orientation * size + row
    number = wp.int32(0)
    first = wp.int32(-1)
    for column in range(size + 1):
        wanted_here = wp.bool(False)
        if column < size:
            wanted_here = wp.int32(classes[orientation, row * size + column]) == wanted
        if wanted_here and first < 0:
            first = column
        if not wanted_here and first >= 0:
            if write:
                cells[starts[index] + number] = wp.vec2i(row * size + first, row * size + column)
            number += 1
            first = wp.int32(-1)
    numbers[index] = number
