"""XFeat (Potje et al., CVPR 2024), sparse, by kornia."""

from __future__ import annotations

from typing import Any

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.descriptors import DescriptorKind
from wheretolook.features.extractor import Extraction, Extractor

XFEAT = DescriptorKind("xfeat", 64, "float16", min_similarity=0.82)

_FILE = "xfeat.pt"
_URLS = ("https://github.com/verlab/accelerated_features/raw/main/weights/xfeat.pt",)


def _build(config: ExtractorConfig, device: str) -> Extraction:
    from torch import Tensor, nn

    from wheretolook.features.learned import Detection, LearnedExtraction, kornia_feature, load_state

    class XFeat(LearnedExtraction):
        dimension = XFEAT.dimension

        def make(self) -> nn.Module:
            network = kornia_feature().XFeat(top_k=config.max_keypoints)
            load_state(network.net, config.weights, _FILE, _URLS)
            return network

        def detect(self, images: Tensor) -> list[Detection]:
            height, width = images.shape[-2:]
            # whole pixels of the image reduced to multiples of 32, counted from the first
            ratio = images.new_tensor([width / max(32, width // 32 * 32), height / max(32, height // 32 * 32)])
            detect: Any = self._network.detectAndCompute
            result = detect(images)
            return [(each["keypoints"] + ratio / 2, each["descriptors"], each["scores"]) for each in result]

    return XFeat(config, device)


EXTRACTORS = (Extractor("xfeat", XFEAT, _build, weights=_FILE, lightglue="xfeat"),)
