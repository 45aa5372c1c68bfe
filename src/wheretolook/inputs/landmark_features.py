"""Attributes of each landmark in view: where it lies in the image, and how it was mapped.

The paper's network is given the landmarks' positions only. Whether they will be found again depends as much on other
attributes: from where they were mapped, how well, and how distinctive they are. All are known from map and pose alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from math import log

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.visibility.frustum import LandmarkSets

BLOCK_ENTRIES = {"cpu": 1 << 15, "cuda": 1 << 22}  # landmarks in view a block: fits the cache, or takes 1 GB of a GPU


@dataclass(frozen=True, eq=False)
class ViewLandmarks:
    """The landmarks in view of each of B views, E entries in all, one view after the other."""

    starts: Tensor  # (B + 1,) int64; view b has entries `starts[b]` to `starts[b + 1]`
    rows: Tensor  # (E,) int64, rows of the landmarks in the map
    values: Tensor  # (E, A) float32
    attributes: tuple[str, ...] = ATTRIBUTES  # names of the A attributes

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def counts(self) -> Tensor:
        """Landmarks of each view, (B,) int64."""
        return self.starts.diff()

    @property
    def views(self) -> Tensor:
        """View of each entry, (E,) int64."""
        return torch.arange(len(self), device=self.starts.device).repeat_interleave(self.counts)


class LandmarkDescriber:
    """Finds the landmarks that views of a map see, and their attributes, on the map's device.

    Of each landmark it gives those of `ATTRIBUTES` that are asked for by name, in that order.
    """

    def __init__(self, localization_map: LocalizationMap, attributes: tuple[str, ...] = ATTRIBUTES) -> None:
        self.localization_map = localization_map
        self.attributes = attributes
        self._columns = [ATTRIBUTES.index(name) for name in attributes]
        landmarks = localization_map.landmarks
        device = localization_map.device
        self._points = torch.from_numpy(landmarks.points).to(device)
        self._directions = torch.from_numpy(landmarks.mapping_direction).to(device)
        self._attributes = torch.from_numpy(landmarks.attributes()).to(device)

    def of_camera(self, camera: Camera) -> LandmarkDescriber:
        """The same with another camera that looks."""
        if camera == self.localization_map.camera:
            return self
        other = copy(self)
        other.localization_map = self.localization_map.of_camera(camera)
        return other

    def describe(self, cam_from_world: Float, in_view: LandmarkSets | None = None) -> ViewLandmarks:
        """Landmarks of views (B, 3, 4); `in_view` are those each of them sees, if that is known already."""
        if in_view is None:
            starts, indices = self.localization_map.in_view_on_device(cam_from_world)
        else:
            starts = in_view.starts.astype(np.int64)
            indices = torch.from_numpy(in_view.indices)
        return self._describe(cam_from_world, torch.from_numpy(starts), indices)

    def _describe(self, cam_from_world: Float, starts: Tensor, indices: Tensor) -> ViewLandmarks:
        device = self._points.device
        starts = starts.to(device)
        rows = indices.to(device, torch.int64)
        rotations, centers = split_poses(np.asarray(cam_from_world, dtype=np.float64))
        from_centers = torch.from_numpy(centers).to(device)
        axes = torch.from_numpy(rotations).to(device)
        if len(starts) > 2:  # a single view needs no index of views
            views = torch.arange(len(starts) - 1, device=device).repeat_interleave(starts.diff())
            from_centers = from_centers[views]
            axes = axes[views]
        offsets = (self._points[rows] - from_centers).float()
        distance = offsets.norm(dim=1)
        # in double precision and rounded once, so that every machine places a landmark at the same point of the image
        x, y, z = (offsets.double()[:, None] @ axes.mT)[:, 0].unbind(1)
        across = (x / z).float()
        down = (y / z).float()
        map_values = self._attributes[rows]
        log_distance = distance.log()
        mapped_angle = (offsets * self._directions[rows]).sum(1) / distance
        ratio = log_distance - map_values[:, MAP_ATTRIBUTES.index("mapped_distance")]
        pixel_angle = torch.full_like(ratio, -log(self.localization_map.camera.mean_focal_px))
        size_ratio = log_distance + pixel_angle - map_values[:, MAP_ATTRIBUTES.index("mapped_pixel_size")]
        pose_values = torch.stack([across, down, log_distance, mapped_angle, ratio, pixel_angle, size_ratio], dim=1)
        values = torch.cat([pose_values, map_values], dim=1)
        if self.attributes != ATTRIBUTES:
            values = values[:, self._columns]
        return ViewLandmarks(starts, rows, values, self.attributes)

    def in_blocks(
        self, cam_from_world: Float, most: int | None = None
    ) -> Iterator[tuple[slice, ViewLandmarks, Tensor]]:
        """Landmarks of views (B, 3, 4), in blocks of views that leave a network over the landmarks room to work.

        Of each view at most `most` landmarks are described, evenly spread over those it sees in the map's order. Yields
        which views a block holds, their landmarks, and how many each of them sees in all.
        """
        starts, indices = self.localization_map.in_view_on_device(cam_from_world)
        n_in_view = np.diff(starts)
        if most is not None and len(n_in_view) and n_in_view.max() > most:
            starts, indices = _thinned(torch.from_numpy(starts), indices, most)
        begin = 0
        room = BLOCK_ENTRIES[self._points.device.type]
        while begin < len(n_in_view):
            # as many views as have at most `room` landmarks together, but at least one
            end = int(np.searchsorted(starts, starts[begin] + room, side="right")) - 1
            end = min(max(end, begin + 1), len(n_in_view))
            rows = slice(begin, end)
            part = torch.from_numpy(starts[begin : end + 1] - starts[begin])
            described = self._describe(cam_from_world[rows], part, indices[int(starts[begin]) : int(starts[end])])
            yield rows, described, torch.from_numpy(n_in_view[rows]).to(self._points.device)
            begin = end


def _thinned(starts: Tensor, indices: Tensor, most: int) -> tuple[NDArray[np.int64], Tensor]:
    """At most `most` entries of each set, evenly spread over it."""
    if len(starts) == 2:
        return np.array([0, most]), indices[torch.arange(most, device=indices.device) * int(starts[1]) // most]
    lengths = starts.diff()
    kept = lengths.clamp(max=most)
    ends = kept.cumsum(0)
    new = torch.cat([torch.zeros(1, dtype=torch.int64), ends])
    # entry k of a set comes from k * length / kept, rounded down
    sets = torch.arange(len(kept), device=indices.device).repeat_interleave(kept.to(indices.device))
    there = torch.stack([starts[:-1], lengths, kept, new[:-1]]).to(indices.device)[:, sets]
    place = torch.arange(len(sets), device=indices.device) - there[3]
    return new.numpy(), indices[there[0] + place * there[1] // there[2]]
