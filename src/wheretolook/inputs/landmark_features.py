"""Attributes of each visible landmark: its position in the image, and how it was mapped.

The paper's network uses the landmarks' positions only. Whether they are detected again depends as much on other
attributes: from where they were mapped, how well, and how distinctive they are. All follow from map and pose alone."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from math import cos, log, radians

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.geometry.views import Views
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES
from wheretolook.visibility.frustum import LandmarkSets
from wheretolook.visibility.occlusion import NoOcclusion

BLOCK_ENTRIES = {
    "cpu": 1 << 15,
    "cuda": 1 << 22,
}  # visible landmarks in a block: fits the cache, or takes 1 GB of a GPU


@dataclass(frozen=True, eq=False)
class ViewLandmarks:
    """The visible landmarks of B views, E entries in all, one view after the other."""

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
    """Describes the landmarks visible in views of a map, on the map's device, by some of `ATTRIBUTES` in any order."""

    def __init__(self, localization_map: LocalizationMap, attributes: tuple[str, ...] = ATTRIBUTES) -> None:
        self.localization_map = localization_map
        self.attributes = attributes
        self._columns = [ATTRIBUTES.index(name) for name in attributes]
        landmarks = localization_map.landmarks
        arrays = landmarks.points, landmarks.mapping_direction, landmarks.attributes()
        self._points, self._directions, self._attributes = (
            torch.from_numpy(array).to(localization_map.device) for array in arrays
        )

    def of_camera(self, camera: Camera) -> LandmarkDescriber:
        """Return a describer of the same map's views with another camera."""
        other = copy(self)
        other.localization_map = self.localization_map.of_camera(camera)
        return other

    def describe(self, cam_from_world: Float, visible: LandmarkSets | None = None) -> ViewLandmarks:
        """Describe the landmarks of views (B, 3, 4): all visible ones, or those in `visible`."""
        if visible is None:
            starts, indices = self.localization_map.in_view_on_device(cam_from_world)
        else:
            starts = visible.starts.astype(np.int64)
            indices = torch.from_numpy(visible.indices)
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
        map_values = self._attributes[rows]
        log_distance = distance.log()
        mapped_angle = (offsets * self._directions[rows]).sum(1) / distance
        ratio = log_distance - map_values[:, MAP_ATTRIBUTES.index("mapped_distance")]
        pixel_angle = torch.full_like(ratio, -log(self.localization_map.camera.mean_focal_px))
        size_ratio = log_distance + pixel_angle - map_values[:, MAP_ATTRIBUTES.index("mapped_pixel_size")]
        of_pose = [(x / z).float(), (y / z).float(), log_distance, mapped_angle, ratio, pixel_angle, size_ratio]
        values = torch.cat([torch.stack(of_pose, dim=1), map_values], dim=1)
        if self.attributes != ATTRIBUTES:
            values = values[:, self._columns]
        return ViewLandmarks(starts, rows, values, self.attributes)

    def in_blocks(
        self, cam_from_world: Float, limit: int | None = None
    ) -> Iterator[tuple[slice, ViewLandmarks, Tensor]]:
        """Describe the landmarks of views (B, 3, 4) in blocks that leave a network over the landmarks memory to work.

        At most `limit` landmarks of each view are described, evenly spread over the visible ones in the map's order.
        Yields which views a block holds, their landmarks, and how many landmarks each of them sees in all.
        """
        starts, indices = self.localization_map.in_view_on_device(cam_from_world)
        n_visible = np.diff(starts)
        if limit is not None and len(n_visible) and n_visible.max() > limit:
            starts, indices = _thinned(torch.from_numpy(starts), indices, limit)
        for rows in ragged_blocks(starts, BLOCK_ENTRIES[self._points.device.type]):
            part = starts[rows.start : rows.stop + 1]
            entries = indices[int(part[0]) : int(part[-1])]
            described = self._describe(cam_from_world[rows], torch.from_numpy(part - part[0]), entries)
            yield rows, described, torch.from_numpy(n_visible[rows]).to(self._points.device)


def ragged_blocks(starts: NDArray[np.int64], limit: int) -> Iterator[slice]:
    """Yield consecutive blocks of sets with at most `limit` entries together, but at least one set each.

    Set k has the entries `starts[k]` to `starts[k + 1]`.
    """
    begin = 0
    while begin < len(starts) - 1:
        end = max(int(np.searchsorted(starts, starts[begin] + limit, side="right")) - 1, begin + 1)
        yield slice(begin, end)
        begin = end


def _thinned(starts: Tensor, indices: Tensor, limit: int) -> tuple[NDArray[np.int64], Tensor]:
    """Return the starts and indices of at most `limit` entries of each set, evenly spread over it."""
    if len(starts) == 2:
        return np.array([0, limit]), indices[torch.arange(limit, device=indices.device) * int(starts[1]) // limit]
    lengths = starts.diff()
    kept = lengths.clamp(max=limit)
    new = torch.cat([torch.zeros(1, dtype=torch.int64), kept.cumsum(0)])
    # entry k of a set comes from k * length / kept, rounded down
    sets = torch.arange(len(kept), device=indices.device).repeat_interleave(kept.to(indices.device))
    first, length, count, begin = torch.stack([starts[:-1], lengths, kept, new[:-1]]).to(indices.device)[:, sets]
    place = torch.arange(len(sets), device=indices.device) - begin
    return new.numpy(), indices[first + place * length // count]


class ReasonCounter:
    """Counts the landmarks of a map that are hard to match in views of it, by reason."""

    def __init__(self, localization_map: LocalizationMap) -> None:
        self.localization_map = localization_map
        hidden = not isinstance(localization_map.occlusion, NoOcclusion)
        self._unoccluded = replace(localization_map, occlusion=NoOcclusion()) if hidden else None
        self._describer = LandmarkDescriber(localization_map, ("distance_ratio", "mapped_angle", "ambiguity"))
        self._has_descriptors = bool(np.isfinite(localization_map.landmarks.ambiguity).any())

    def count(self, cam_from_world: Float) -> Views:
        """Return views with poses (B, 3, 4) and these numbers; a landmark may have several reasons."""
        n_occluded = np.zeros(len(cam_from_world), dtype=np.int64)
        if self._unoccluded is not None:
            starts, _ = self._unoccluded.in_view_on_device(cam_from_world)
            n_occluded += np.diff(starts)
        counts = np.zeros((len(cam_from_world), 3), dtype=np.int64)
        for rows, described, n_visible in self._describer.in_blocks(cam_from_world):
            if self._unoccluded is not None:
                n_occluded[rows] -= n_visible.cpu().numpy()
            ratio, cosine, ambiguity = described.values.unbind(1)
            # beyond these, the bundled weights expect landmarks to be detected about half as often, or less
            limits = ratio > log(2.0), cosine < cos(radians(45)), ambiguity > 0.95
            hard = torch.stack(limits, 1).double()
            sums = torch.segment_reduce(hard, "sum", lengths=described.counts, axis=0, initial=0.0)
            counts[rows] = sums.cpu().numpy()
        too_far, too_oblique, repeated = counts.T
        return Views(
            cam_from_world,
            n_occluded=n_occluded,
            n_too_far=too_far,
            n_too_oblique=too_oblique,
            n_repeated=repeated * (1.0 if self._has_descriptors else np.nan),
        )
