"""Base class of extractors that are networks of kornia: weights and batches of images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.extractor import Keypoints, check_image
from wheretolook.utils.errors import ConfigError, WeightsError

INSTALL = "pip install 'wheretolook[learned]'"

MIN_SIDE_PX = 16  # networks halve images four times

Detection = tuple[Tensor, Tensor, Tensor]
"""Keypoints of an image: pixels (N, 2), (0.5, 0.5) is the centre of the first; unit descriptors (N, D); scores (N,)."""


class LearnedExtraction(ABC):
    """A keypoint network of kornia: runs on a CPU core image by image, on a GPU in batches.

    Raises ConfigError without kornia, WeightsError if weights are missing or of another network.
    """

    dimension: int

    def __init__(self, config: ExtractorConfig, device: str) -> None:
        self.config = config
        self.device = torch.device(device)
        # an H100 needs a sixth of the time per image in a batch of 16; larger batches gain nothing
        self.batch = 1 if self.device.type == "cpu" else 16
        self._network = self.make().eval().to(self.device)

    @abstractmethod
    def make(self) -> nn.Module:
        """The network with its weights, on a CPU."""

    @abstractmethod
    def detect(self, images: Tensor) -> list[Detection]:
        """Keypoints of images (B, 3, H, W), RGB in 0..1, on the device."""

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Keypoints of images (H, W, 3) uint8 of one size, those of highest score first."""
        for rgb in images:
            check_image(rgb)
        if not len(images) or min(images[0].shape[:2]) < MIN_SIDE_PX:
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
        raise ConfigError("learned features need kornia, which is not installed", fix=f"{INSTALL}.") from error
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
