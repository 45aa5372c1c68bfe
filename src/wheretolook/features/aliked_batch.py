"""Runs ALIKED on all images of a batch at once, where kornia runs on one image after the other."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wheretolook.features.learned import Detection


def detect_and_describe(network: Any, images: Tensor) -> list[Detection]:
    """Detect and describe keypoints in images (B, 3, H, W), RGB in 0..1, as kornia's `ALIKED` does.

    On a GPU the many small steps for one image take as long as those for a batch. Keypoints are the same; sums are in
    another order.
    """
    features, scores = network.extract_dense_map(images)
    n_images = len(scores)
    image, pixels, keypoint_scores = _detected(network.dkd, scores)
    counts = torch.bincount(image, minlength=n_images).tolist()
    if not any(counts):
        return detect_by_kornia(network, images)
    # kornia's own way for images without a keypoint above the threshold, or with too many: both are rare
    exceptions = {
        i: detect_by_kornia(network, images[i : i + 1])[0]
        for i, n in enumerate(counts)
        if not 0 < n <= network.dkd.n_limit
    }
    parts = zip(*(values.split(counts) for values in (pixels, keypoint_scores)), strict=True)
    descriptors = _described(network.desc_head, features, image, pixels, counts).split(counts)
    return [
        exceptions.get(i, (at, described, scored))
        for i, ((at, scored), described) in enumerate(zip(parts, descriptors, strict=True))
    ]


def detect_by_kornia(network: nn.Module, images: Tensor) -> list[Detection]:
    """Detect and describe keypoints with kornia, image by image."""
    return [(each.keypoints, each.descriptors, each.keypoint_scores) for each in network(images)]


def _detected(detector: Any, scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Strict maxima of score maps (B, 1, H, W) above the threshold and off the border: image, pixel and score.

    A maximum is moved by the mean of its window, weighted by the softmax of scores (ALIKED, Sec. III-C).
    """
    radius = detector.radius
    size = detector.kernel_size
    height, width = scores.shape[2:]
    largest = F.max_pool2d(scores, size, 1, radius)
    candidates = (scores == largest) & (scores > detector.scores_th)
    inside = candidates[:, 0, radius : height - radius, radius : width - radius]
    image, row, column = inside.nonzero().unbind(1)
    row = row + radius
    column = column + radius
    step = torch.arange(-radius, radius + 1, device=scores.device)
    window = (step[:, None] * width + step).flatten()
    middle = (image * height + row) * width + column
    window_scores = scores.flatten()[middle[:, None] + window]
    strict = (window_scores == window_scores.amax(1, keepdim=True)).sum(
        1
    ) == 1  # of two equal ones neither is a maximum
    image = image[strict]
    row = row[strict]
    column = column[strict]
    window_scores = window_scores[strict]
    weights = ((window_scores - window_scores.amax(1, keepdim=True)) / detector.temperature).exp()
    offset = weights @ detector.hw_grid / weights.sum(1, keepdim=True)
    pixels = torch.stack([column, row], 1) + offset
    return image, pixels, _bilinear(scores, image, pixels)


def _bilinear(scores: Tensor, image: Tensor, pixels: Tensor) -> Tensor:
    """Values of maps (B, 1, H, W) at pixels (N, 2) of images (N,)."""
    _, _, height, width = scores.shape
    x, y = pixels.long().unbind(1)
    x = x.clamp(0, width - 2)
    y = y.clamp(0, height - 2)
    right, down = (pixels - torch.stack([x, y], 1)).unbind(1)
    corner = (image * height + y) * width + x
    corners = scores.flatten()[corner[:, None] + torch.tensor([0, 1, width, width + 1], device=scores.device)]
    weights = torch.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], 1)
    return (corners * weights).sum(1)


def _described(head: Any, features: Tensor, image: Tensor, pixels: Tensor, counts: list[int]) -> Tensor:
    """Unit descriptors (N, D) of pixels (N, 2) of images (N,) in ascending order, `counts` of each.

    Features (B, D, H, W) are sampled at positions that a small network sets by the window of each pixel, and summed
    with a matrix for each position (ALIKED, Sec. III-B, SDDH).
    """
    n_images, depth, height, width = features.shape
    max_count = max(counts)
    n = len(image)
    slot = torch.cat([torch.arange(count, device=image.device) for count in counts])
    start = (pixels.long() - head.kernel_size / 2 + 1).long()
    limit = torch.tensor([width, height], device=image.device) - 1 - head.kernel_size
    start = torch.minimum(start.clamp(min=0), limit)
    step = torch.arange(head.kernel_size, device=image.device)
    window = (step[:, None] * width + step).flatten()
    flat = features.new_zeros((n_images, max_count, len(window)), dtype=torch.long)
    flat[image, slot] = (start[:, 1] * width + start[:, 0])[:, None] + window
    patches = features.flatten(2).gather(2, flat.flatten(1)[:, None].expand(-1, depth, -1))
    patches = patches.view(n_images, depth, max_count, -1)[image, :, slot]
    max_offset = max(height, width) / 4
    offsets = head.offset_conv(patches.view(n, depth, head.kernel_size, head.kernel_size)).clamp(
        -max_offset, max_offset
    )
    positions = pixels[:, None] + offsets.view(n, 2, head.n_pos).transpose(1, 2)
    span = torch.tensor([width - 1, height - 1], device=image.device)
    grid = features.new_zeros((n_images, max_count, head.n_pos, 2))
    grid[image, slot] = 2 * positions / span - 1
    sampled = F.grid_sample(features, grid, mode="bilinear", align_corners=True)  # (B, D, max_count, positions)
    sampled = torch.selu(head.sf_conv(sampled)).permute(0, 2, 3, 1)[image, slot]
    return F.normalize(torch.einsum("npc,pcd->nd", sampled, head.agg_weights), dim=1)
