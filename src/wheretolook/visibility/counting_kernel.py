"""Warp kernels that count and list landmarks by cells of the sphere."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.frustum_kernel import FAR, cell_of, in_view, offset_from, surely_in_sides

wp.set_module_options({"enable_backward": False})

INSIDE = wp.constant(1)
BORDER = wp.constant(2)


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
        if not outside:
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
    n_orientations: wp.int32,
    size: wp.int32,
    write: wp.bool,
    starts: wp.array[wp.int32],
    numbers: wp.array[wp.int32],
    cells: wp.array[wp.vec2i],
):
    """Count the runs of cells of each class in each row of the map and, with `write`, list them from `starts` on.

    Those of class INSIDE come first, in all orientations.
    """
    border, orientation, row = wp.tid()
    wanted = wp.where(border == 1, BORDER, INSIDE)
    index = (border * n_orientations + orientation) * size + row
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
    """Find the cell of every landmark around every location, and its place among the landmarks of that cell.

    `numbers` counts the landmarks of each cell. A landmark that is occluded or not finite gets the cell -1.
    """
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
            cell = size * size  # the last cell: too near the camera, where depth matters, or too far; always tested
            distance = wp.length(offset)
            if distance > near_radius and distance < FAR:
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
    """Write the offsets of each location's landmarks, cell by cell."""
    location, landmark = wp.tid()
    place = places[location, landmark]
    if place[0] >= 0:
        entry = starts[location * (size * size + 1) + place[0]] + place[1]
        offsets[entry] = offset_from(locations[location], points[landmark])


@wp.struct
class SortedLandmarks:
    """The landmarks of a block of locations sorted into cells, and the cells of each orientation (`cells_in_view`)."""

    size: wp.int32  # cells along a side of the sphere's map
    inside_starts: wp.array[wp.int32]  # see `CellRuns`
    inside: wp.array[wp.vec2i]
    border_starts: wp.array[wp.int32]
    border: wp.array[wp.vec2i]
    starts: wp.array[wp.int32]  # first entry of each cell of each location in `offsets`
    offsets: wp.array[wp.vec3]  # from the location
    rows: wp.array[wp.int32]  # which landmark each entry is, if entries are listed


@wp.func
def inside_runs(s: SortedLandmarks, orientation: wp.int32) -> wp.vec2i:
    """First run of cells that are wholly in view, and the one after the last."""
    return wp.vec2i(s.inside_starts[orientation * s.size], s.inside_starts[(orientation + 1) * s.size])


@wp.func
def border_runs(s: SortedLandmarks, orientation: wp.int32) -> wp.vec2i:
    return wp.vec2i(s.border_starts[orientation * s.size], s.border_starts[(orientation + 1) * s.size])


@wp.func
def entries_of(s: SortedLandmarks, location: wp.int32, run: wp.vec2i) -> wp.vec2i:
    """First entry in a run of cells of a location, and the one after the last."""
    base = location * (s.size * s.size + 1)
    return wp.vec2i(s.starts[base + run[0]], s.starts[base + run[1]])


@wp.func
def near_entries(s: SortedLandmarks, location: wp.int32) -> wp.vec2i:
    """Entries of the last cell, whose landmarks every orientation tests."""
    n_cells = s.size * s.size
    return entries_of(s, location, wp.vec2i(n_cells, n_cells + 1))


@wp.func
def count_inside(
    s: SortedLandmarks, location: wp.int32, orientation: wp.int32, lane: wp.int32, lanes: wp.int32
) -> wp.int32:
    """Number of landmarks in every lanes-th run of cells that are wholly in view."""
    count = wp.int32(0)
    runs = inside_runs(s, orientation)
    for run in range(runs[0] + lane, runs[1], lanes):
        entries = entries_of(s, location, s.inside[run])
        count += entries[1] - entries[0]
    return count


@wp.kernel
def count_kernel(
    sides: wp.array2d[wp.vec3],
    landmarks: SortedLandmarks,
    rounding: wp.float32,
    min_depth: wp.float64,
    lanes: wp.int32,
    counts: wp.array2d[wp.int32],
):
    """Count the landmarks in view. Several threads (lanes) share a view, that is, a location and an orientation."""
    location, orientation, lane = wp.tid()
    count = count_inside(landmarks, location, orientation, lane, lanes)
    left = sides[orientation, 0]
    right = sides[orientation, 1]
    top = sides[orientation, 2]
    bottom = sides[orientation, 3]
    runs = border_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        entries = entries_of(landmarks, location, landmarks.border[run])
        for entry in range(entries[0] + lane, entries[1], lanes):
            offset = landmarks.offsets[entry]
            if surely_in_sides(left, right, top, bottom, offset, rounding):
                count += 1
    near = near_entries(landmarks, location)
    for entry in range(near[0] + lane, near[1], lanes):
        if in_view(sides, orientation, landmarks.offsets[entry], min_depth):
            count += 1
    if count > 0:
        wp.atomic_add(counts, location, orientation, count)


@wp.func
def list_unsure(
    location: wp.int32,
    orientation: wp.int32,
    offset: wp.vec3,
    number: wp.array[wp.int32],
    pairs: wp.array[wp.vec2i],
    offsets: wp.array[wp.vec3],
):
    """Append to the list, or only count where it is full."""
    slot = wp.atomic_add(number, 0, 1)
    if slot < offsets.shape[0]:
        pairs[slot] = wp.vec2i(location, orientation)
        offsets[slot] = offset


@wp.kernel
def count_field_kernel(
    rotations: wp.array[wp.mat33],
    depth: wp.array[wp.float32],
    field_size: wp.int32,
    landmarks: SortedLandmarks,
    first: wp.int32,
    lanes: wp.int32,
    counts: wp.array2d[wp.int32],
    n_unsure: wp.array[wp.int32],
    unsure_pairs: wp.array[wp.vec2i],
    unsure_offsets: wp.array[wp.vec3],
):
    """As `count_kernel`, by a table of the field of view. Landmarks it cannot decide are listed for the camera."""
    row, lane = wp.tid()
    location = (first + row) / counts.shape[1]
    orientation = first + row - location * counts.shape[1]
    count = count_inside(landmarks, location, orientation, lane, lanes)
    runs = border_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        entries = entries_of(landmarks, location, landmarks.border[run])
        for entry in range(entries[0] + lane, entries[1], lanes):
            offset = landmarks.offsets[entry]
            inside_by = depth[cell_of(rotations[orientation] * offset, field_size)]
            if inside_by > 0.0:
                count += 1
            elif inside_by == 0.0:
                list_unsure(location, orientation, offset, n_unsure, unsure_pairs, unsure_offsets)
    near = near_entries(landmarks, location)
    for entry in range(near[0] + lane, near[1], lanes):
        list_unsure(location, orientation, landmarks.offsets[entry], n_unsure, unsure_pairs, unsure_offsets)
    if count > 0:
        wp.atomic_add(counts, location, orientation, count)


@wp.kernel
def best_kernel(counts: wp.array2d[wp.int32], n_directions: wp.int32, keep: wp.int32, best: wp.array2d[wp.int32]):
    """List the directions with the highest counts, ties by direction; each thread finds the rank of one direction."""
    location, direction = wp.tid()
    count = counts[location, direction]
    rank = wp.int32(0)
    for other in range(n_directions):
        difference = counts[location, other] - count
        if difference > 0 or (difference == 0 and other < direction):
            rank += 1
    if rank < keep:
        best[location, rank] = direction


@wp.kernel
def pack_kernel(mask: wp.array2d[wp.bool], rank: wp.array[wp.int32], packed: wp.array2d[wp.uint8]):
    """Pack the mask eight landmarks to the byte, the first in the highest bit, as `numpy.packbits` does."""
    location, byte = wp.tid()
    bits = wp.int32(0)
    for bit in range(8):
        landmark = byte * 8 + bit
        if landmark < mask.shape[1] and mask[location, rank[wp.min(landmark, mask.shape[1] - 1)]]:
            bits |= 128 >> bit
    packed[location, byte] = wp.uint8(bits)


@wp.kernel
def rows_kernel(places: wp.array2d[wp.vec2i], starts: wp.array[wp.int32], n_cells: wp.int32, rows: wp.array[wp.int32]):
    """Write which landmark each entry is that `sort_kernel` has sorted."""
    location, landmark = wp.tid()
    place = places[location, landmark]
    if place[0] >= 0:
        rows[starts[location * n_cells + place[0]] + place[1]] = landmark


@wp.func
def image_of(rotation: wp.mat33, offset: wp.vec3) -> wp.vec2:
    """x / z and y / z in the camera."""
    there = rotation * offset
    return wp.vec2(there[0] / there[2], there[1] / there[2])


@wp.func
def list_inside(
    landmarks: SortedLandmarks,
    location: wp.int32,
    orientation: wp.int32,
    stride: wp.int32,
    rotation: wp.mat33,
    begin: wp.int64,
    end: wp.int64,
    entries: wp.array[wp.int32],
    image: wp.array[wp.vec2],
) -> wp.int64:
    """Count, and list from `begin` to `end`, the landmarks of cells that are wholly in view."""
    at = begin
    runs = inside_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        span = entries_of(landmarks, location, landmarks.inside[run])
        if begin == end and stride == 1:
            at += wp.int64(span[1] - span[0])
        else:
            for entry in range(span[0], span[1]):
                if landmarks.rows[entry] % stride == 0:
                    at = list_one(at, end, entry, landmarks.offsets[entry], rotation, entries, image)
    return at


@wp.func
def list_one(
    at: wp.int64,
    end: wp.int64,
    entry: wp.int32,
    offset: wp.vec3,
    rotation: wp.mat33,
    entries: wp.array[wp.int32],
    image: wp.array[wp.vec2],
) -> wp.int64:
    """Write a landmark where there is room, and return the next place."""
    if at < end:
        entries[at] = entry
        image[at] = image_of(rotation, offset)
    return at + wp.int64(1)


@wp.kernel
def list_kernel(
    views: wp.array[wp.vec3i],
    rotations: wp.array[wp.mat33],
    sides: wp.array2d[wp.vec3],
    rounding: wp.float32,
    min_depth: wp.float64,
    landmarks: SortedLandmarks,
    ends: wp.array[wp.int64],
    lengths: wp.array[wp.int64],
    entries: wp.array[wp.int32],
    image: wp.array[wp.vec2],
):
    """Count the landmarks in view of each view, and list as many as there is room for, from `ends[view]` on.

    A view is a location, an orientation and a stride: only landmarks whose rows it divides count. The test is that of
    `count_kernel`.
    """
    view = wp.tid()
    location = views[view][0]
    orientation = views[view][1]
    stride = views[view][2]
    begin = ends[view]
    end = ends[view + 1]
    rotation = rotations[orientation]
    at = list_inside(landmarks, location, orientation, stride, rotation, begin, end, entries, image)
    left = sides[orientation, 0]
    right = sides[orientation, 1]
    top = sides[orientation, 2]
    bottom = sides[orientation, 3]
    runs = border_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        span = entries_of(landmarks, location, landmarks.border[run])
        for entry in range(span[0], span[1]):
            if landmarks.rows[entry] % stride == 0:
                offset = landmarks.offsets[entry]
                if surely_in_sides(left, right, top, bottom, offset, rounding):
                    at = list_one(at, end, entry, offset, rotation, entries, image)
    span = near_entries(landmarks, location)
    for entry in range(span[0], span[1]):
        if landmarks.rows[entry] % stride == 0:
            offset = landmarks.offsets[entry]
            if in_view(sides, orientation, offset, min_depth):
                at = list_one(at, end, entry, offset, rotation, entries, image)
    lengths[view] = at - begin


@wp.kernel
def list_field_kernel(
    views: wp.array[wp.vec3i],
    rotations: wp.array[wp.mat33],
    depth: wp.array[wp.float32],
    field_size: wp.int32,
    landmarks: SortedLandmarks,
    ends: wp.array[wp.int64],
    lengths: wp.array[wp.int64],
    entries: wp.array[wp.int32],
    image: wp.array[wp.vec2],
):
    """As `list_kernel`, by a table of the field of view. What it cannot decide is listed as -1 - entry."""
    view = wp.tid()
    location = views[view][0]
    orientation = views[view][1]
    stride = views[view][2]
    begin = ends[view]
    end = ends[view + 1]
    rotation = rotations[orientation]
    at = list_inside(landmarks, location, orientation, stride, rotation, begin, end, entries, image)
    runs = border_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        span = entries_of(landmarks, location, landmarks.border[run])
        for entry in range(span[0], span[1]):
            if landmarks.rows[entry] % stride == 0:
                offset = landmarks.offsets[entry]
                inside_by = depth[cell_of(rotation * offset, field_size)]
                if inside_by >= 0.0:
                    listed = wp.where(inside_by > 0.0, entry, -1 - entry)
                    at = list_one(at, end, listed, offset, rotation, entries, image)
    span = near_entries(landmarks, location)
    for entry in range(span[0], span[1]):
        if landmarks.rows[entry] % stride == 0:
            at = list_one(at, end, -1 - entry, landmarks.offsets[entry], rotation, entries, image)
    lengths[view] = at - begin
