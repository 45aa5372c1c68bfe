"""Warp kernel that counts the distinct pixels landmarks fall on, the released code's rule."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.counting_kernel import SortedLandmarks, border_runs, entries_of, inside_runs, near_entries
from wheretolook.visibility.frustum_kernel import in_view, pixel_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False})  # the latter for `pixel_of`


@wp.func
def pixel_number(
    axes: wp.mat33, offset: wp.vec3, focal: wp.vec2d, center: wp.vec2d, width: wp.int32, height: wp.int32
) -> wp.int32:
    pixel = pixel_of(axes, offset, focal, center)
    column = wp.clamp(wp.int32(wp.floor(pixel[0])), 0, width - 1)
    row = wp.clamp(wp.int32(wp.floor(pixel[1])), 0, height - 1)
    return row * width + column


@wp.func
def mark(bits: wp.array2d[wp.uint32], view: wp.int32, pixel: wp.int32) -> wp.int32:
    """Mark a pixel of a view as taken. Returns 1 if it was not yet, else 0."""
    word = pixel >> 5
    bit = wp.uint32(1) << wp.uint32(pixel & 31)
    before = wp.atomic_or(bits, view, word, bit)
    return wp.where((before & bit) == wp.uint32(0), 1, 0)


@wp.kernel
def count_pixels_kernel(
    sides: wp.array2d[wp.vec3],
    axes: wp.array[wp.mat33],
    landmarks: SortedLandmarks,
    focal: wp.vec2d,
    center: wp.vec2d,
    width: wp.int32,
    height: wp.int32,
    min_depth: wp.float64,
    first: wp.int32,
    lanes: wp.int32,
    bits: wp.array2d[wp.uint32],
    counts: wp.array2d[wp.int32],
):
    """As `count_kernel`, but a landmark counts only if no other was counted at its pixel."""
    view, lane = wp.tid()
    location = (first + view) / axes.shape[0]
    orientation = first + view - location * axes.shape[0]
    axis = axes[orientation]
    count = wp.int32(0)
    runs = inside_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        entries = entries_of(landmarks, location, landmarks.inside[run])
        for entry in range(entries[0] + lane, entries[1], lanes):
            count += mark(bits, view, pixel_number(axis, landmarks.offsets[entry], focal, center, width, height))
    runs = border_runs(landmarks, orientation)
    for run in range(runs[0], runs[1]):
        entries = entries_of(landmarks, location, landmarks.border[run])
        for entry in range(entries[0] + lane, entries[1], lanes):
            if in_view(sides, orientation, landmarks.offsets[entry], min_depth):
                count += mark(bits, view, pixel_number(axis, landmarks.offsets[entry], focal, center, width, height))
    near = near_entries(landmarks, location)
    for entry in range(near[0] + lane, near[1], lanes):
        if in_view(sides, orientation, landmarks.offsets[entry], min_depth):
            count += mark(bits, view, pixel_number(axis, landmarks.offsets[entry], focal, center, width, height))
    if count > 0:
        wp.atomic_add(counts, location, orientation, count)
