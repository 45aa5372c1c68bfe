"""Warp kernels that list the landmarks in view of many orientations at a location, by cells of the sphere."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.counting_kernel import (
    FAR,
    SortedLandmarks,
    border_runs,
    cell_of,
    entries_of,
    inside_runs,
    near_entries,
)
from wheretolook.visibility.frustum_kernel import in_view, inside_sides, least_product, offset_from, rounding_error

wp.set_module_options({"enable_backward": False})


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


@wp.kernel
def list_kernel(
    views: wp.array[wp.vec2i],
    rotations: wp.array[wp.mat33],
    sides: wp.array2d[wp.vec3],
    landmarks: SortedLandmarks,
    rounding: wp.float32,
    min_depth: wp.float64,
    write: wp.bool,
    first: wp.array[wp.int64],
    lengths: wp.array[wp.int64],
    entries: wp.array[wp.int32],
    image: wp.array[wp.vec2],
):
    """Count the landmarks in view of each view, a location and an orientation; with `write`, list them from `first` on.

    The test is that of `count_kernel`.
    """
    view = wp.tid()
    location = views[view][0]
    orientation = views[view][1]
    number = wp.int64(0)
    begin = wp.int64(0)
    if write:
        begin = first[view]
    rotation = rotations[orientation]
    runs = inside_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        span = entries_of(landmarks, location, landmarks.inside[run])
        if write:
            for entry in range(span[0], span[1]):
                at = begin + number + wp.int64(entry - span[0])
                entries[at] = entry
                image[at] = image_of(rotation, landmarks.offsets[entry])
        number += wp.int64(span[1] - span[0])
    left = sides[orientation, 0]
    right = sides[orientation, 1]
    top = sides[orientation, 2]
    bottom = sides[orientation, 3]
    runs = border_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        span = entries_of(landmarks, location, landmarks.border[run])
        for entry in range(span[0], span[1]):
            offset = landmarks.offsets[entry]
            least = least_product(left, right, top, bottom, offset)
            error = rounding_error(offset, rounding)
            seen = least > error
            if not seen and least >= -error:
                seen = inside_sides(left, right, top, bottom, offset)
            if seen:
                if write:
                    entries[begin + number] = entry
                    image[begin + number] = image_of(rotation, offset)
                number += wp.int64(1)
    span = near_entries(landmarks, location)
    for entry in range(span[0], span[1]):
        if in_view(sides, orientation, landmarks.offsets[entry], min_depth):
            if write:
                entries[begin + number] = entry
                image[begin + number] = image_of(rotation, landmarks.offsets[entry])
            number += wp.int64(1)
    lengths[view] = number


@wp.kernel
def list_field_kernel(
    views: wp.array[wp.vec2i],
    rotations: wp.array[wp.mat33],
    depth: wp.array[wp.float32],
    field_size: wp.int32,
    landmarks: SortedLandmarks,
    write: wp.bool,
    first: wp.array[wp.int64],
    lengths: wp.array[wp.int64],
    entries: wp.array[wp.int32],
    image: wp.array[wp.vec2],
):
    """As `list_kernel`, by a table of the field of view. What it cannot decide is listed as -1 - entry."""
    view = wp.tid()
    location = views[view][0]
    orientation = views[view][1]
    number = wp.int64(0)
    begin = wp.int64(0)
    if write:
        begin = first[view]
    rotation = rotations[orientation]
    runs = inside_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        span = entries_of(landmarks, location, landmarks.inside[run])
        if write:
            for entry in range(span[0], span[1]):
                at = begin + number + wp.int64(entry - span[0])
                entries[at] = entry
                image[at] = image_of(rotation, landmarks.offsets[entry])
        number += wp.int64(span[1] - span[0])
    runs = border_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        span = entries_of(landmarks, location, landmarks.border[run])
        for entry in range(span[0], span[1]):
            offset = landmarks.offsets[entry]
            inside_by = depth[cell_of(rotation * offset, field_size)]
            if inside_by >= 0.0:
                if write:
                    entries[begin + number] = wp.where(inside_by > 0.0, entry, -1 - entry)
                    image[begin + number] = image_of(rotation, offset)
                number += wp.int64(1)
    span = near_entries(landmarks, location)
    for entry in range(span[0], span[1]):
        if write:
            entries[begin + number] = -1 - entry
            image[begin + number] = image_of(rotation, landmarks.offsets[entry])
        number += wp.int64(1)
    lengths[view] = number


@wp.kernel
def collect_field_kernel(
    rotations: wp.array[wp.mat33],
    centers: wp.array[wp.vec3d],
    location_rows: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    starts: wp.array[wp.int32],
    unoccluded: wp.array[wp.int32],
    depth: wp.array[wp.float32],
    field_size: wp.int32,
    write: wp.bool,
    first: wp.array[wp.int64],
    lengths: wp.array[wp.int64],
    indices: wp.array[wp.int32],
):
    """As `collect_kernel`, by a table of the field of view. What it cannot decide is listed as -1 - landmark."""
    view = wp.tid()
    location = location_rows[view]
    number = wp.int64(0)
    begin = wp.int64(0)
    if write:
        begin = first[view]
    for entry in range(starts[location], starts[location + 1]):
        landmark = unoccluded[entry]
        offset = offset_from(centers[view], points[landmark])
        if wp.isfinite(offset):
            distance = wp.length(offset)
            inside_by = wp.float32(0.0)
            if distance > 0.0 and distance < FAR:
                inside_by = depth[cell_of(rotations[view] * offset, field_size)]
            if inside_by >= 0.0:
                if write:
                    indices[begin + number] = wp.where(inside_by > 0.0, landmark, -1 - landmark)
                number += wp.int64(1)
    lengths[view] = number
