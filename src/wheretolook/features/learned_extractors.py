"""ALIKED, DISK and XFeat by kornia, and the descriptors of SuperPoint, which is only read from files."""

from __future__ import annotations

from typing import Any

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.extractor import DescriptorKind, Extraction, Extractor

ALIKED = DescriptorKind("aliked", 128, "float16", min_similarity=0.8, colmap_type=1)

_ALIKED_FILE = "aliked-n16rot.pth"
_ALIKED_URLS = (
    "https://huggingface.co/kornia/aliked/resolve/main/aliked-n16rot.pth",
    "https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-n16rot.pth",
)
_LEAST_SCORE = 0.2  # of a keypoint, the authors' own


def _build_aliked(config: ExtractorConfig, device: str) -> Extraction:
    from torch import Tensor, nn

    from wheretolook.features.aliked_batch import detect_and_describe, simplify
    from wheretolook.features.learned import Detection, LearnedExtraction, kornia_feature, load_state

    class Aliked(LearnedExtraction):
        dimension = ALIKED.dimension

        def make(self) -> nn.Module:
            network = kornia_feature().ALIKED("aliked-n16rot", config.max_keypoints, _LEAST_SCORE)
            return simplify(load_state(network, config.weights, _ALIKED_FILE, _ALIKED_URLS))

        def detect(self, images: Tensor) -> list[Detection]:
            # ALIKED counts pixels from the middle of the first
            result = detect_and_describe(self._network, images)
            return [(pixels + 0.5, descriptors, scores) for pixels, descriptors, scores in result]

    return Aliked(config, device)


_ALIKED = (Extractor("aliked", ALIKED, _build_aliked, weights=_ALIKED_FILE, lightglue="aliked"),)


DISK = DescriptorKind("disk", 128, "float16", min_similarity=0.8)

_DISK_FILE = "depth-save.pth"
_DISK_URLS = (
    "https://huggingface.co/kornia/disk/resolve/main/depth-save.pth",
    "https://raw.githubusercontent.com/cvlab-epfl/disk/master/depth-save.pth",
)


def _build_disk(config: ExtractorConfig, device: str) -> Extraction:
    from torch import Tensor, nn

    from wheretolook.features.learned import Detection, LearnedExtraction, kornia_feature, load_state

    class Disk(LearnedExtraction):
        dimension = DISK.dimension

        def make(self) -> nn.Module:
            return load_state(
                kornia_feature().DISK(), config.weights, _DISK_FILE, _DISK_URLS, lambda state: state["extractor"]
            )

        def detect(self, images: Tensor) -> list[Detection]:
            result = self._network(images, n=config.max_keypoints, pad_if_not_divisible=True)
            # whole pixels, counted from the first
            return [(each.keypoints + 0.5, each.descriptors, each.detection_scores) for each in result]

    return Disk(config, device)


_DISK = (Extractor("disk", DISK, _build_disk, weights=_DISK_FILE, lightglue="disk"),)


# hloc's "NN-superpoint" matches up to a distance of 0.7 between unit descriptors: 1 - 0.7^2 / 2
SUPERPOINT = DescriptorKind("superpoint", 256, "float16", min_similarity=0.755)

_SUPERPOINT = (Extractor("superpoint", SUPERPOINT, lightglue="superpoint"),)


XFEAT = DescriptorKind("xfeat", 64, "float16", min_similarity=0.82)

_XFEAT_FILE = "xfeat.pt"
_XFEAT_URLS = ("https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt",)


def _build_xfeat(config: ExtractorConfig, device: str) -> Extraction:
    from torch import Tensor, nn

    from wheretolook.features.learned import Detection, LearnedExtraction, kornia_feature, load_state

    class XFeat(LearnedExtraction):
        dimension = XFEAT.dimension

        def make(self) -> nn.Module:
            network = kornia_feature().XFeat(top_k=config.max_keypoints)
            load_state(network.net, config.weights, _XFEAT_FILE, _XFEAT_URLS)
            return network

        def detect(self, images: Tensor) -> list[Detection]:
            height, width = images.shape[-2:]
            # whole pixels of the image reduced to multiples of 32, counted from the first
            ratio = images.new_tensor([width / max(32, width // 32 * 32), height / max(32, height // 32 * 32)])
            detect: Any = self._network.detectAndCompute
            result = detect(images)
            return [(each["keypoints"] + ratio / 2, each["descriptors"], each["scores"]) for each in result]

    return XFeat(config, device)


_XFEAT = (Extractor("xfeat", XFEAT, _build_xfeat, weights=_XFEAT_FILE, lightglue="xfeat"),)


EXTRACTORS = (*_ALIKED, *_DISK, *_XFEAT, *_SUPERPOINT)
