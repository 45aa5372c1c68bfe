"""Warp kernels that sort the landmarks of each location into cells of the sphere and count those in view."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.frustum_kernel import in_view, inside_sides, offset_from
from wheretolook.visibility.sphere_cells_kernel import cell_of


@wp.kernel
def cell_kernel(
    locations: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    masked: wp.bool,
    unoccluded: wp.array2d[wp.bool],
    size: wp.int32,
    near_radius: wp.float32,
    places: wp.array2d[wp.vec2i],
    numbers: wp.array[wp.int32],
):
    """Cell of every landmark around every location, and its place among those of the cell."""
    location, landmark = wp.tid()
    n_cells = size * size + 1
    cell = wp.int32(-1)
    place = wp.int32(0)
    free = wp.bool(True)
    if masked:
        free = unoccluded[location, landmark]
    if free:
        offset = offset_from(locations[location], points[landmark])
        if wp.isfinite(offset):
            cell = size * size  # close to the camera the depth matters too: these are tested whole
            if wp.length(offset) > near_radius:
                cell = cell_of(offset, size)
            place = wp.atomic_add(numbers, location * n_cells + cell, 1)
    places[location, landmark] = wp.vec2i(cell, place)


@wp.kernel
def sort_kernel(
    locations: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    places: wp.array2d[wp.vec2i],
    starts: wp.array[wp.int32],
    size: wp.int32,
    offsets: wp.array[wp.vec3],
):
    """Offsets of the landmarks of a location, cell by cell."""
    location, landmark = wp.tid()
    place = places[location, landmark]
    if place[0] >= 0:
        entry = starts[location * (size * size + 1) + place[0]] + place[1]
        offsets[entry] = offset_from(locations[location], points[landmark])


@wp.kernel
def count_kernel(
    sides: wp.array2d[wp.vec3],
    inside_starts: wp.array[wp.int32],
    inside: wp.array[wp.vec2i],
    border_starts: wp.array[wp.int32],
    border: wp.array[wp.vec2i],
    starts: wp.array[wp.int32],
    offsets: wp.array[wp.vec3],
    size: wp.int32,
    rounding: wp.float32,
    min_depth: wp.float64,
    lanes: wp.int32,
    counts: wp.array2d[wp.int32],
):
    """Several threads (lanes) share a location and an orientation."""
    location, orientation, lane = wp.tid()
    base = location * (size * size + 1)
    count = wp.int32(0)
    for run in range(inside_starts[orientation * size] + lane, inside_starts[(orientation + 1) * size], lanes):
        count += starts[base + inside[run][1]] - starts[base + inside[run][0]]
    left = sides[orientation, 0]
    right = sides[orientation, 1]
    top = sides[orientation, 2]
    bottom = sides[orientation, 3]
    for run in range(border_starts[orientation * size], border_starts[(orientation + 1) * size]):
        for entry in range(starts[base + border[run][0]] + lane, starts[base + border[run][1]], lanes):
            offset = offsets[entry]
            # in single precision first; within its rounding error of a side, in double
            least = wp.min(
                wp.min(wp.dot(left, offset), wp.dot(right, offset)), wp.min(wp.dot(top, offset), wp.dot(bottom, offset))
            )
            error = rounding * (wp.abs(offset[0]) + wp.abs(offset[1]) + wp.abs(offset[2]))
            if least > error:
                count += 1
            elif least >= -error:  # noqa: SIM102 (Warp evaluates both sides of an `and`)
                if inside_sides(left, right, top, bottom, offset):
                    count += 1
    near = base + size * size
    for entry in range(starts[near] + lane, starts[near + 1], lanes):
        if in_view(sides, orientation, offsets[entry], min_depth):
            count += 1
    if count > 0:
        wp.atomic_add(counts, location, orientation, count)


@wp.kernel
def count_field_kernel(
    rotations: wp.array[wp.mat33],
    depth: wp.array[wp.float32],
    field_size: wp.int32,
    inside_starts: wp.array[wp.int32],
    inside: wp.array[wp.vec2i],
    border_starts: wp.array[wp.int32],
    border: wp.array[wp.vec2i],
    starts: wp.array[wp.int32],
    offsets: wp.array[wp.vec3],
    size: wp.int32,
    first: wp.int32,
    lanes: wp.int32,
    counts: wp.array2d[wp.int32],
    n_unsure: wp.array[wp.int32],
    pairs: wp.array[wp.vec2i],
    unsure: wp.array[wp.vec3],
):
    """As `count_kernel`, by a table of the field of view; what it cannot decide is listed for the camera itself."""
    row, orientation, lane = wp.tid()
    location = first + row
    base = location * (size * size + 1)
    count = wp.int32(0)
    for run in range(inside_starts[orientation * size] + lane, inside_starts[(orientation + 1) * size], lanes):
        count += starts[base + inside[run][1]] - starts[base + inside[run][0]]
    for run in range(border_starts[orientation * size], border_starts[(orientation + 1) * size]):
        for entry in range(starts[base + border[run][0]] + lane, starts[base + border[run][1]], lanes):
            inside_by = depth[cell_of(rotations[orientation] * offsets[entry], field_size)]
            if inside_by > 0.0:
                count += 1
            elif inside_by == 0.0:
                slot = wp.atomic_add(n_unsure, 0, 1)
                if slot < unsure.shape[0]:
                    pairs[slot] = wp.vec2i(location, orientation)
                    unsure[slot] = offsets[entry]
    near = base + size * size
    for entry in range(starts[near] + lane, starts[near + 1], lanes):
        slot = wp.atomic_add(n_unsure, 0, 1)
        if slot < unsure.shape[0]:
            pairs[slot] = wp.vec2i(location, orientation)
            unsure[slot] = offsets[entry]
    if count > 0:
        wp.atomic_add(counts, location, orientation, count)


@wp.kernel
def pack_kernel(mask: wp.array2d[wp.bool], rank: wp.array[wp.int32], packed: wp.array2d[wp.uint8]):
    """Eight landmarks to the byte, the first in the highest bit."""
    location, byte = wp.tid()
    bits = wp.int32(0)
    for bit in range(8):
        landmark = byte * 8 + bit
        if landmark < mask.shape[1] and mask[location, rank[wp.min(landmark, mask.shape[1] - 1)]]:
            bits |= 128 >> bit
    packed[location, byte] = wp.uint8(bits)
