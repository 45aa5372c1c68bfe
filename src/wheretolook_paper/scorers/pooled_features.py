"""Statistics of the visible landmarks of a view, the inputs of the boosted trees; and the image cells they fall into."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from wheretolook.geometry.camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.landmark_features import ViewLandmarks

FILLED = 30  # bins along each side of the image, of which the filled ones are counted, as in the paper
COARSE = 4  # bins along each side of the coarse grid
QUANTILES = (0.1, 0.5, 0.9)

POOLED = (
    "log_visible",  # log(1 + landmarks)
    "log_filled",  # log(1 + filled bins of 30 x 30)
    "coarse_filled",  # filled bins of 4 x 4
    "log_coarse_lower_half",  # sum of log(1 + landmarks) over the fuller half of those
    "axis_height",  # height of the optical axis, -1 to 1
    *(f"{name}_{kind}" for name in ATTRIBUTES for kind in ("mean", "std", *(f"q{100 * q:.0f}" for q in QUANTILES))),
)
"""Outputs of `pool`: five numbers, and mean, standard deviation and quantiles of each attribute."""


def pool(landmarks: ViewLandmarks, cam_from_world: Float, camera: Camera) -> Tensor:
    """Return statistics (B, len(POOLED)) float32 of the landmarks of views (B, 3, 4); NaN for views without landmarks."""
    n = len(landmarks)
    views = landmarks.views
    device = landmarks.values.device
    counts = landmarks.counts.float()
    fine, coarse = (_occupied(landmarks, views, camera, bins) for bins in (FILLED, COARSE))
    fuller = coarse.sort(dim=1).values[:, COARSE**2 // 2 :]
    axis = torch.from_numpy(np.asarray(cam_from_world, dtype=np.float32)[:, 2, 2]).to(device)
    filled = (fine > 0).sum(1).float()
    coarse_filled = (coarse > 0).sum(1).float()
    parts = [counts.log1p(), filled.log1p(), coarse_filled, fuller.log1p().sum(1), axis]
    divisor = counts.clamp(min=1)
    nan_if_empty = torch.where(counts > 0, 1.0, torch.nan)
    for column in range(len(ATTRIBUTES)):
        values = landmarks.values[:, column].double()
        mean = _sums(values, views, n) / divisor
        spread = (_sums((values - mean[views]) ** 2, views, n) / divisor).sqrt()
        parts += [(mean * nan_if_empty).float(), (spread * nan_if_empty).float()]
        parts += _quantiles(values, landmarks, views)
    return torch.stack(parts, dim=1)


def _sums(values: Tensor, views: Tensor, n: int) -> Tensor:
    return torch.zeros(n, dtype=torch.float64, device=values.device).index_add_(0, views, values)


def _occupied(landmarks: ViewLandmarks, views: Tensor, camera: Camera, bins: int) -> Tensor:
    """Count the landmarks in each bin of the image, (B, bins^2) float32."""
    cells = views * bins**2 + image_cells(landmarks, camera, bins)
    return torch.bincount(cells, minlength=len(landmarks) * bins**2).view(len(landmarks), bins**2).float()


def image_cells(landmarks: ViewLandmarks, camera: Camera, bins: int) -> Tensor:
    """Return the cell (E,) int64 of bins x bins cells of the image, row by row, that each landmark falls into."""
    rays = torch.stack([landmarks.values[:, landmarks.attributes.index(name)] for name in ("across", "down")], dim=1)
    if isinstance(camera, ColmapCamera):
        along = torch.cat([rays, torch.ones_like(rays[:, :1])], dim=1)
        pixels = torch.from_numpy(camera.project(along.cpu().double().numpy())).to(rays)
    else:
        focal, center = torch.tensor([[camera.fx, camera.fy], [camera.cx, camera.cy]]).to(rays)
        pixels = rays * focal + center
    column = (pixels[:, 0] * (bins / camera.width)).long().clamp(0, bins - 1)
    row = (pixels[:, 1] * (bins / camera.height)).long().clamp(0, bins - 1)
    return row * bins + column


def _quantiles(values: Tensor, landmarks: ViewLandmarks, views: Tensor) -> list[Tensor]:
    """Return nearest-rank quantiles of each view's values, (B,) each."""
    unknown = values.isnan()
    # one sort serves all views: the integer part of the key is the view, its fraction follows the value
    key = views.double() + (values.nan_to_num().atan() / torch.pi + 0.5) * 0.999
    ordered = values[key.argsort()]
    counts = landmarks.counts
    starts = landmarks.starts[:-1]
    blank = (counts == 0) | (_sums(unknown.double(), views, len(landmarks)) > 0)
    quantiles = []
    for q in QUANTILES:
        rank = (q * (counts - 1).clamp(min=0) + 0.5).long()
        at = (starts + rank).clamp(max=max(0, len(values) - 1))
        value = ordered[at] if len(values) else torch.zeros(len(landmarks), dtype=torch.float64, device=values.device)
        quantiles.append(torch.where(blank, torch.nan, value).float())
    return quantiles
