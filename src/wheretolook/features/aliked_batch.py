"""Runs ALIKED on all images of a batch at once, where kornia runs on one image after the other.

Features of an image's own size, 128 numbers a pixel, take a GPU more time and memory than all convolutions. They are
computed only where keypoints need them.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from wheretolook.features.learned import Detection


def simplify(network: Any) -> Any:
    """Fold normalization into the convolutions of kornia's `ALIKED`, in place, and replace the deformable ones."""
    for block in (network.block1, network.block2, network.block3, network.block4):
        for i in "12":
            convolution = getattr(block, f"conv{i}")
            norm = getattr(block, f"bn{i}").eval()
            if isinstance(convolution, nn.Conv2d):
                convolution = fuse_conv_bn_eval(convolution.eval(), norm)
            else:
                regular = fuse_conv_bn_eval(convolution.regular_conv.eval(), norm)
                convolution = _DeformableConvolution(convolution.offset_conv, regular)
            setattr(block, f"conv{i}", convolution)
            setattr(block, f"bn{i}", nn.Identity())
    return network


class _DeformableConvolution(nn.Module):
    """A 3 x 3 convolution at moved pixels (Dai et al., ICCV 2017); kornia samples them in thirty operations."""

    def __init__(self, offset: nn.Conv2d, regular: nn.Conv2d) -> None:
        super().__init__()
        self.offset = offset
        self.regular: Any = regular

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[2:]
        max_offset = max(height, width) / 4
        down, right = self.offset(x).clamp(-max_offset, max_offset).unflatten(1, (9, 2)).unbind(2)  # (B, 9, H, W)
        row, column = torch.meshgrid(*(torch.arange(n, device=x.device) for n in (height, width)), indexing="ij")
        step = torch.arange(9, device=x.device)[:, None, None]
        to_x = 2 * (right + column + step % 3) - 1  # twice the distance from the left border
        to_y = 2 * (down + row + step // 3) - 1
        grid = torch.stack([to_x / width - 1, to_y / height - 1], -1).flatten(1, 2)
        sampled = F.grid_sample(x, grid, align_corners=False).unflatten(2, (9, height))
        result = self.regular.weight.flatten(1) @ sampled.flatten(1, 2).flatten(2)
        return (result + self.regular.bias[:, None]).unflatten(2, (height, width))


def detect_and_describe(network: Any, images: Tensor) -> list[Detection]:
    """Detect and describe keypoints in images (B, 3, H, W), RGB in 0..1, as kornia's `ALIKED` does.

    The network is one of `simplify`. Keypoints are kornia's; sums are in another order.
    """
    n_images, _, height, width = images.shape
    levels, scores = _maps(network, images)
    image, pixels = _detected(network.dkd, scores)
    slot, counts = _slots(image, n_images)
    numbers = counts.tolist()
    at = pixels.new_zeros((n_images, max(1, *numbers), 2))
    at[image, slot] = pixels
    places = 2 * at / torch.tensor([width - 1, height - 1], device=at.device) - 1
    keypoint_scores = F.grid_sample(scores, places[:, None], align_corners=True)[image, 0, 0, slot]
    descriptors = _described(network.desc_head, levels, at, (width, height))[image, slot]
    return list(zip(*(values.split(numbers) for values in (pixels, descriptors, keypoint_scores)), strict=True))


def _maps(network: Any, images: Tensor) -> tuple[list[Tensor], Tensor]:
    """Features of four sizes, (B, D / 4, h, w) each, of images padded to multiples of 32, and scores (B, 1, H, W).

    Scores are of features of one size, but their first layer is linear: it is applied before the upsampling.
    """
    height, width = images.shape[2:]
    left, top = (-side % 32 // 2 for side in (width, height))
    padding = [left, -width % 32 - left, top, -height % 32 - top]
    x1 = network.block1(F.pad(images, padding, mode="replicate"))
    x2 = network.block2(network.pool2(x1))
    x3 = network.block3(network.pool4(x2))
    x4 = network.block4(network.pool4(x3))
    convolutions = (network.conv1, network.conv2, network.conv3, network.conv4)
    levels = [network.gate(conv(x)) for conv, x in zip(convolutions, (x1, x2, x3, x4), strict=True)]
    first, *rest = network.score_head
    total, *others = (F.conv2d(*both) for both in zip(levels, first.weight.chunk(4, 1), strict=True))
    for each in others:
        total = total + F.interpolate(each, total.shape[2:], mode="bilinear", align_corners=True)
    for layer in rest:
        total = layer(total)
    return levels, total.sigmoid()[..., top : top + height, left : left + width].contiguous()


def _slots(image: Tensor, n_images: int) -> tuple[Tensor, Tensor]:
    """Number of each keypoint in its image, from images (N,) in ascending order, and keypoints (B,) of each image."""
    start = torch.searchsorted(image, torch.arange(n_images + 1, device=image.device))
    return torch.arange(len(image), device=image.device) - start[image], start.diff()


def _detected(detector: Any, scores: Tensor) -> tuple[Tensor, Tensor]:
    """Strict maxima of score maps (B, 1, H, W) above the threshold and off the border: images and pixels.

    In an image without one, those above its mean score. A maximum is moved by the mean of its window, weighted by the
    softmax of scores (ALIKED, Sec. III-C).
    """
    radius = detector.radius
    size = detector.kernel_size
    n_images, _, height, width = scores.shape
    largest = F.max_pool2d(scores, size, 1, radius)
    mean = scores.mean((1, 2, 3), keepdim=True)
    candidates = (scores == largest) & (scores > mean.clamp(max=detector.scores_th))
    inside = candidates[:, 0, radius : height - radius, radius : width - radius]
    image, row, column = inside.nonzero().unbind(1)
    row = row + radius
    column = column + radius
    step = torch.arange(-radius, radius + 1, device=scores.device)
    window = (step[:, None] * width + step).flatten()
    middle = (image * height + row) * width + column
    window_scores = scores.flatten()[middle[:, None] + window]
    peak = window_scores.amax(1)
    strict = (window_scores == peak[:, None]).sum(1) == 1  # of two equal ones neither is a maximum
    above = strict & (peak > detector.scores_th)
    n_above = torch.zeros(n_images, dtype=torch.long, device=scores.device).index_add_(0, image, above.long())
    kept = (strict & (above | (n_above == 0)[image])).nonzero()[:, 0]
    kept = kept[(image[kept].double() - peak[kept]).argsort()]  # by image, then from the highest: scores are 0 to 1
    kept = kept[_slots(image[kept], n_images)[0] < detector.n_limit]
    image = image[kept]
    weights = ((window_scores[kept] - peak[kept, None]) / detector.temperature).exp()
    offset = weights @ detector.hw_grid / weights.sum(1, keepdim=True)
    pixels = torch.stack([column[kept], row[kept]], 1) + offset
    return image, pixels


def _described(head: Any, levels: list[Tensor], at: Tensor, size: tuple[int, int]) -> Tensor:
    """Unit descriptors (B, K, D) at pixels (B, K, 2) of images of a size (width, height).

    Features are sampled at positions that a small network sets by the window of each pixel, and summed with a matrix
    for each position (ALIKED, Sec. III-B, SDDH).
    """
    n_images, count = at.shape[:2]
    padded = levels[0].shape[:1:-1]

    def sample(pixels: Tensor) -> tuple[list[Tensor], Tensor]:
        """Features (B, D / 4, K, P) at whole pixels (B, K, P, 2), and the inverse of their length (B, K, P)."""
        moved = (pixels[..., i] + (padded[i] - size[i]) // 2 for i in (0, 1))
        grid = torch.stack([2 * x / (side - 1) - 1 for x, side in zip(moved, padded, strict=True)], -1)
        parts = [F.grid_sample(level, grid, align_corners=True) for level in levels]
        return parts, torch.stack([part.square().sum(1) for part in parts]).sum(0).clamp(min=1e-24).rsqrt()

    def box(pixels: Tensor, margin: int) -> Tensor:
        """Pixels moved into the image without its last `margin` rows and columns."""
        return torch.stack([pixels[..., i].clamp(0, size[i] - 1 - margin) for i in (0, 1)], -1)

    side = head.kernel_size
    step = torch.arange(side * side, device=at.device)
    window = torch.stack([step % side, step // side], -1)
    parts, scale = sample(box((at.long() - side / 2 + 1).trunc(), side)[:, :, None] + window)
    patches = torch.cat(parts, 1) * scale[:, None]
    first, gate, second = head.offset_conv
    hidden = F.linear(patches.transpose(1, 2).flatten(2), first.weight.flatten(1), first.bias)
    max_offset = max(size) / 4
    offsets = F.linear(gate(hidden), second.weight.flatten(1), second.bias).clamp(-max_offset, max_offset)
    positions = at[:, :, None] + offsets.view(n_images, count, 2, head.n_pos).transpose(2, 3)
    step = torch.arange(4, device=at.device)
    corner = torch.stack([step % 2, step // 2], -1)[:, None]
    corners = positions.floor()[:, :, None] + corner  # (B, K, 4, positions, 2)
    weights = (1 - (positions[:, :, None] - corners).abs()).prod(-1) * (corners == box(corners, 0)).all(-1)
    parts, scale = sample(corners.flatten(2, 3))
    scale = scale * weights.flatten(2)
    sampled = torch.cat([(part * scale[:, None]).unflatten(3, (4, head.n_pos)).sum(3) for part in parts], 1)
    sampled = torch.selu(head.sf_conv(sampled))
    return F.normalize(torch.einsum("bckp,pcd->bkd", sampled, head.agg_weights), dim=2)
