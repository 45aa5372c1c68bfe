"""What is known of each landmark that a view sees: where it lies in the image, and how it was mapped.

The paper's network is told where landmarks are. Whether they will be found again depends as much on what they are like:
from where they were mapped, how well, and how unlike others. All of it is known from the map and the pose alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.geometry.colmap_camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.visibility.frustum import VisibleSets

BLOCK_ENTRIES = {"cpu": 1 << 15, "cuda": 1 << 22}
"""Landmarks in view that a network over them looks at together: what stays in the cache, or a gigabyte of a GPU's."""


@dataclass(frozen=True, eq=False)
class ViewLandmarks:
    """The landmarks that B views see, E in all, one view after the other.

    Attributes:
        starts: (B + 1,) int64; view b has entries `starts[b]` to `starts[b + 1]`.
        rows: (E,) int64, rows of the landmarks in the map.
        values: (E, A) float32.
        attributes: names of the A attributes.
    """

    starts: Tensor
    rows: Tensor
    values: Tensor
    attributes: tuple[str, ...] = ATTRIBUTES

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
    """Describes the landmarks that views of a map see.

    Args:
        localization_map: landmarks, camera, occlusion, and the device to work on.
        attributes: what to tell of each landmark: some of `ATTRIBUTES`, by name, in the order asked for.
    """

    def __init__(self, localization_map: LocalizationMap, attributes: tuple[str, ...] = ATTRIBUTES) -> None:
        self.localization_map, self.attributes = localization_map, attributes
        self._columns = [ATTRIBUTES.index(name) for name in attributes]
        landmarks, device = localization_map.landmarks, localization_map.device
        self._points = torch.from_numpy(landmarks.points).to(device)
        self._directions = torch.from_numpy(landmarks.mapping_direction).to(device)
        self._attributes = torch.from_numpy(landmarks.attributes()).to(device)

    def describe(self, cam_from_world: Float, visible: VisibleSets | None = None) -> ViewLandmarks:
        """What views see.

        Args:
            cam_from_world: (B, 3, 4).
            visible: the landmarks each of them sees, if that is known already.

        Returns:
            On the map's device.
        """
        if visible is None:
            starts, indices = self.localization_map.visible_on_device(cam_from_world)
        else:
            starts, indices = visible.starts.astype(np.int64), torch.from_numpy(visible.indices)
        return self._describe(cam_from_world, torch.from_numpy(starts), indices)

    def _describe(self, cam_from_world: Float, starts: Tensor, indices: Tensor) -> ViewLandmarks:
        device = self._points.device
        starts, rows = starts.to(device), indices.to(device, torch.int64)
        rotations, centers = split_poses(np.asarray(cam_from_world, dtype=np.float64))
        from_centers, axes = torch.from_numpy(centers).to(device), torch.from_numpy(rotations).to(device, torch.float32)
        if len(starts) > 2:  # what the only view sees need not be told whose it is
            views = torch.arange(len(starts) - 1, device=device).repeat_interleave(starts.diff())
            from_centers, axes = from_centers[views], axes[views]
        offsets = (self._points[rows] - from_centers).float()
        distance = offsets.norm(dim=1)
        x, y, z = (offsets[:, None] @ axes.mT)[:, 0].unbind(1)
        of_map = self._attributes[rows]
        log_distance = distance.log()
        of_pose = torch.stack(
            [
                x / z,
                y / z,
                log_distance,
                (offsets * self._directions[rows]).sum(1) / distance,
                log_distance - of_map[:, MAP_ATTRIBUTES.index("mapped_distance")],
            ],
            dim=1,
        )
        values = torch.cat([of_pose, of_map], dim=1)
        if self.attributes != ATTRIBUTES:
            values = values[:, self._columns]
        return ViewLandmarks(starts, rows, values, self.attributes)

    def in_blocks(
        self, cam_from_world: Float, most: int | None = None
    ) -> Iterator[tuple[slice, ViewLandmarks, Tensor]]:
        """What views (B, 3, 4) see, so many at a time that a network over the landmarks has room to work.

        Args:
            cam_from_world: (B, 3, 4).
            most: describe at most so many landmarks of a view, evenly spread over those it sees in the map's order.

        Yields:
            Which of the views, their landmarks, and how many each of them sees in all.
        """
        starts, indices = self.localization_map.visible_on_device(cam_from_world)
        visible = np.diff(starts)
        if most is not None and len(visible) and visible.max() > most:
            starts, indices = _thinned(torch.from_numpy(starts), indices, most)
        begin, room = 0, BLOCK_ENTRIES[self._points.device.type]
        while begin < len(visible):
            # as many views as have at most so many landmarks, but one at least
            end = int(np.searchsorted(starts, starts[begin] + room, side="right")) - 1
            end = min(max(end, begin + 1), len(visible))
            rows = slice(begin, end)
            part = torch.from_numpy(starts[begin : end + 1] - starts[begin])
            described = self._describe(cam_from_world[rows], part, indices[int(starts[begin]) : int(starts[end])])
            yield rows, described, torch.from_numpy(visible[rows]).to(self._points.device)
            begin = end


def _thinned(starts: Tensor, indices: Tensor, most: int) -> tuple[NDArray[np.int64], Tensor]:
    """At most so many entries of each set, evenly spread over it."""
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


FILLED = 30
"""Bins along each side of the image, of which the filled ones are counted, as in the paper."""

COARSE = 4
"""Bins along each side of the coarse grid."""

QUANTILES = (0.1, 0.5, 0.9)

POOLED = (
    "log_visible", "log_filled", "coarse_filled", "log_coarse_lower_half", "axis_height",
    *(f"{name}_{kind}" for name in ATTRIBUTES for kind in ("mean", "std", *(f"q{100 * q:.0f}" for q in QUANTILES))),
)  # fmt: skip
"""What `pool` tells of a view: log(1 + landmarks), log(1 + filled bins of 30 x 30), filled bins of 4 x 4, the sum of
log(1 + landmarks) over the fuller half of those, the height of the optical axis; and of each attribute its mean,
standard deviation and quantiles over the landmarks."""


def pool(landmarks: ViewLandmarks, cam_from_world: Float, camera: Camera) -> Tensor:
    """Statistics of the landmarks of each view, (B, len(POOLED)) float32; NaN where a view has none to tell of.

    Args:
        landmarks: of the views.
        cam_from_world: (B, 3, 4), for the height of the axis.
        camera: whose image the bins divide.
    """
    n, views, device = len(landmarks), landmarks.views, landmarks.values.device
    counts = landmarks.counts.float()
    fine, coarse = (_occupied(landmarks, views, camera, bins) for bins in (FILLED, COARSE))
    fuller = coarse.sort(dim=1).values[:, COARSE**2 // 2 :]
    axis = torch.from_numpy(np.asarray(cam_from_world, dtype=np.float32)[:, 2, 2]).to(device)
    parts = [
        counts.log1p(), (fine > 0).sum(1).float().log1p(), (coarse > 0).sum(1).float(), fuller.log1p().sum(1), axis,
    ]  # fmt: skip
    some = counts.clamp(min=1)
    middle = torch.where(counts > 0, 1.0, torch.nan)  # of nothing there is no mean
    for column in range(len(ATTRIBUTES)):
        values = landmarks.values[:, column].double()
        mean = _sums(values, views, n) / some
        spread = (_sums((values - mean[views]) ** 2, views, n) / some).sqrt()
        parts += [(mean * middle).float(), (spread * middle).float()]
        parts += _quantiles(values, landmarks, views)
    return torch.stack(parts, dim=1)


def _sums(values: Tensor, views: Tensor, n: int) -> Tensor:
    return torch.zeros(n, dtype=torch.float64, device=values.device).index_add_(0, views, values)


def _occupied(landmarks: ViewLandmarks, views: Tensor, camera: Camera, bins: int) -> Tensor:
    """Landmarks in each bin of the image, (B, bins^2) float32."""
    cells = views * bins**2 + image_cells(landmarks, camera, bins)
    return torch.bincount(cells, minlength=len(landmarks) * bins**2).view(len(landmarks), bins**2).float()


def image_cells(landmarks: ViewLandmarks, camera: Camera, bins: int) -> Tensor:
    """Which of bins x bins cells of the image, row by row, each landmark falls into, (E,) int64."""
    rays = torch.stack([landmarks.values[:, landmarks.attributes.index(name)] for name in ("across", "down")], dim=1)
    if isinstance(camera, ColmapCamera):
        along = torch.cat([rays, torch.ones_like(rays[:, :1])], dim=1)
        pixels = torch.from_numpy(camera.project(along.cpu().double().numpy())).to(rays)
    else:
        pixels = rays * camera.focal_px + torch.tensor([camera.cx, camera.cy]).to(rays)
    column = (pixels[:, 0] * (bins / camera.width)).long().clamp(0, bins - 1)
    row = (pixels[:, 1] * (bins / camera.height)).long().clamp(0, bins - 1)
    return row * bins + column


def _quantiles(values: Tensor, landmarks: ViewLandmarks, views: Tensor) -> list[Tensor]:
    """Nearest-rank quantiles of each view's values, (B,) each."""
    unknown = values.isnan()
    # one sort for all views: the view is the key's whole part, the value's place in it the fraction
    key = views.double() + (values.nan_to_num().atan() / torch.pi + 0.5) * 0.999
    ordered = values[key.argsort()]
    counts, starts = landmarks.counts, landmarks.starts[:-1]
    blank = (counts == 0) | (_sums(unknown.double(), views, len(landmarks)) > 0)
    found = []
    for q in QUANTILES:
        rank = (q * (counts - 1).clamp(min=0) + 0.5).long()
        at = (starts + rank).clamp(max=max(0, len(values) - 1))
        value = ordered[at] if len(values) else torch.zeros(len(landmarks), dtype=torch.float64, device=values.device)
        found.append(torch.where(blank, torch.nan, value).float())
    return found
