"""ALIKED (Zhao et al., IEEE TIM 2023), its network n16rot, by kornia."""

from __future__ import annotations

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.descriptors import DescriptorKind
from wheretolook.features.extractor import Extraction, Extractor

ALIKED = DescriptorKind("aliked", 128, "float16", min_similarity=0.8, colmap_type=1)

_FILE = "aliked-n16rot.pth"
_URLS = (
    "https://huggingface.co/kornia/aliked/resolve/main/aliked-n16rot.pth",
    "https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-n16rot.pth",
)
_LEAST_SCORE = 0.2  # of a keypoint, the authors' own


def _build(config: ExtractorConfig, device: str) -> Extraction:
    from torch import Tensor, nn

    from wheretolook.features.aliked_batch import detect_and_describe, simplify
    from wheretolook.features.learned import Detection, LearnedExtraction, kornia_feature, load_state

    class Aliked(LearnedExtraction):
        dimension = ALIKED.dimension

        def make(self) -> nn.Module:
            network = kornia_feature().ALIKED("aliked-n16rot", config.max_keypoints, _LEAST_SCORE)
            return simplify(load_state(network, config.weights, _FILE, _URLS))

        def detect(self, images: Tensor) -> list[Detection]:
            # ALIKED counts pixels from the middle of the first
            result = detect_and_describe(self._network, images)
            return [(pixels + 0.5, descriptors, scores) for pixels, descriptors, scores in result]

    return Aliked(config, device)


EXTRACTORS = (Extractor("aliked", ALIKED, _build, weights=_FILE, lightglue="aliked"),)
