"""Extractors that are networks of kornia: ALIKED, DISK and XFeat, their weights, and batches of images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from wheretolook.features.extractor import EXTRACTORS, ExtractorConfig, Keypoints, check_image
from wheretolook.utils.errors import ConfigError, WeightsError

Detection = tuple[Tensor, Tensor, Tensor]
"""Keypoints of an image: pixels (N, 2), (0.5, 0.5) is the centre of the first; unit descriptors (N, D); scores (N,)."""


class LearnedExtraction(ABC):
    """A keypoint network of kornia: runs on a CPU core image by image, on a GPU in batches.

    Raises ConfigError without kornia, WeightsError if weights are missing or of another network.
    """

    def __init__(self, config: ExtractorConfig, device: str) -> None:
        self.config = config
        self.record = EXTRACTORS[config.method]
        self.dimension = self.record.descriptors.dimension
        self.device = torch.device(device)
        # an H100 needs a sixth of the time per image in a batch of 16; larger batches gain nothing
        self.batch = 1 if self.device.type == "cpu" else 16
        self._network = self.make().eval().to(self.device)

    @abstractmethod
    def make(self) -> nn.Module:
        """The network with its weights, on a CPU."""

    def load(self, network: nn.Module, prepare: Callable[[dict[str, Any]], dict[str, Any]] = dict) -> nn.Module:
        """Load the weights that the options name into a network (see `load_state`)."""
        return load_state(network, self.config.weights, self.record.weights, self.record.urls, prepare)

    @abstractmethod
    def detect(self, images: Tensor) -> list[Detection]:
        """Keypoints of images (B, 3, H, W), RGB in 0..1, on the device."""

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Keypoints of images (H, W, 3) uint8 of one size, those of highest score first."""
        for rgb in images:
            check_image(rgb)
        if not len(images) or min(images[0].shape[:2]) < 16:  # networks halve images four times
            return [Keypoints.none(self.dimension) for _ in images]
        # on a CPU a batch takes as long, but several times the memory
        parts = [images] if self.batch > 1 else [[rgb] for rgb in images]
        keypoints: list[Keypoints] = []
        with torch.inference_mode(), one_thread():
            for part in parts:
                whole = torch.from_numpy(np.ascontiguousarray(part)).to(self.device)
                keypoints += self._keypoints(self.detect(whole.permute(0, 3, 1, 2).float() / 255))
        return keypoints

    def _keypoints(self, detections: list[Detection]) -> Iterator[Keypoints]:
        # one transfer from the device for all images
        joined = (torch.cat(values).float().cpu().numpy() for values in zip(*detections, strict=True))
        ends = np.cumsum([len(scores) for _, _, scores in detections])[:-1]
        for pixels, descriptors, scores in zip(*(np.split(values, ends) for values in joined), strict=True):
            keep = np.lexsort((pixels[:, 0], pixels[:, 1], -scores))[: self.config.max_keypoints]
            yield Keypoints(pixels[keep], descriptors[keep].reshape(-1, self.dimension))


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit PyTorch to one thread: workers have a core each, and sums do not depend on the number of cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def kornia_feature() -> Any:
    """The module `kornia.feature`. Raises ConfigError if it is not installed."""
    try:
        import kornia.feature
    except ImportError as error:
        raise ConfigError(
            "learned features need kornia, which is not installed", fix="pip install 'wheretolook[learned]'."
        ) from error
    return kornia.feature


def load_state(
    network: nn.Module,
    weights: str,
    name: str,
    urls: Sequence[str],
    prepare: Callable[[dict[str, Any]], dict[str, Any]] = dict,
    option: str = "--mapping.extractor.weights (of check and localize --extractor-weights)",
) -> nn.Module:
    """Load the weights of a network from a file, or kornia's copy from its cache or the URLs.

    A download is announced on standard error. `name` is the usual name of the file; `prepare` turns its content into
    the network's tensors by name. Raises WeightsError if the file is missing, damaged, or of another network, or if
    none is given and the download fails.
    """
    fix = f"Give the file {name}: {option} FILE."
    if weights and not Path(weights).is_file():
        raise WeightsError("there are no such weights", path=weights, fix=fix)
    try:
        if weights:
            state = torch.load(weights, map_location="cpu", weights_only=True)
        else:
            from kornia.core.download import load_state_dict_from_url

            state = load_state_dict_from_url(list(urls), map_location="cpu", timeout=30)
        missing, unknown = network.load_state_dict(prepare(state), strict=False)
        if unknown or {*missing} & {name for name, _ in network.named_parameters()}:  # constants may be missing
            raise ValueError("other tensors")
        if not all(bool(tensor.isfinite().all()) for tensor in network.state_dict().values()):
            raise ValueError("some are not finite")
    except Exception as error:  # the unpickler, the download and the network raise errors of many kinds
        reason = str(error).strip().partition("\n")[0].partition(" Cache path:")[0].rstrip(".") or type(error).__name__
        if isinstance(error, UnpicklingError):  # PyTorch's own text suggests an unsafe way
            reason = "the file holds more than tensors, or none"
        problem = f"cannot use weights of {type(network).__name__} as in {name}: {reason}"
        raise WeightsError(problem, path=weights or None, fix=fix) from error
    return network


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
    """Detect and describe keypoints in images (B, 3, H, W), RGB in 0..1, as kornia's `ALIKED` does one after the other.

    Features of the images' size, 128 numbers a pixel, take a GPU more time and memory than all convolutions. They are
    computed only where keypoints need them. The network is one of `simplify`. Keypoints are kornia's; sums are in another order.
    """
    n_images, _, height, width = images.shape
    levels, scores = _maps(network, images)
    image, pixels = _detected(network.dkd, scores)
    slot, counts = _slots(image, n_images)
    numbers = counts.tolist()
    at = pixels.new_zeros((n_images, max([1, *numbers]), 2))
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
    total, *others = (F.conv2d(level, part) for level, part in zip(levels, first.weight.chunk(4, 1), strict=True))
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


class Aliked(LearnedExtraction):
    """ALIKED (Zhao et al., 2023), on all images of a batch at once."""

    def make(self) -> nn.Module:
        least_score = 0.2  # of a keypoint, the authors' own
        network = kornia_feature().ALIKED("aliked-n16rot", self.config.max_keypoints, least_score)
        return simplify(self.load(network))

    def detect(self, images: Tensor) -> list[Detection]:
        # ALIKED counts pixels from the middle of the first
        result = detect_and_describe(self._network, images)
        return [(pixels + 0.5, descriptors, scores) for pixels, descriptors, scores in result]


class Disk(LearnedExtraction):
    """DISK (Tyszkiewicz et al., NeurIPS 2020)."""

    def make(self) -> nn.Module:
        return self.load(kornia_feature().DISK(), lambda state: state["extractor"])

    def detect(self, images: Tensor) -> list[Detection]:
        result = self._network(images, n=self.config.max_keypoints, pad_if_not_divisible=True)
        # whole pixels, counted from the first
        return [(each.keypoints + 0.5, each.descriptors, each.detection_scores) for each in result]


class XFeat(LearnedExtraction):
    """XFeat (Potje et al., CVPR 2024)."""

    def make(self) -> nn.Module:
        network = kornia_feature().XFeat(top_k=self.config.max_keypoints)
        self.load(network.net)
        return network

    def detect(self, images: Tensor) -> list[Detection]:
        height, width = images.shape[-2:]
        # whole pixels of the image reduced to multiples of 32, counted from the first
        ratio = images.new_tensor([width / max(32, width // 32 * 32), height / max(32, height // 32 * 32)])
        detect: Any = self._network.detectAndCompute
        result = detect(images)
        return [(each["keypoints"] + ratio / 2, each["descriptors"], each["scores"]) for each in result]
