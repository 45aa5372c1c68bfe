"""DISK (Tyszkiewicz et al., NeurIPS 2020), trained with depth, by kornia."""

from __future__ import annotations

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.descriptors import DescriptorKind
from wheretolook.features.extractor import Extraction, Extractor

DISK = DescriptorKind("disk", 128, "float16", min_similarity=0.8)

_FILE = "depth-save.pth"
_URLS = (
    "https://huggingface.co/kornia/disk/resolve/main/depth-save.pth",
    "https://raw.githubusercontent.com/cvlab-epfl/disk/master/depth-save.pth",
)


def _build(config: ExtractorConfig, device: str) -> Extraction:
    from torch import Tensor, nn

    from wheretolook.features.learned import Detection, LearnedExtraction, kornia_feature, load_state

    class Disk(LearnedExtraction):
        dimension = DISK.dimension

        def make(self) -> nn.Module:
            return load_state(kornia_feature().DISK(), config.weights, _FILE, _URLS, lambda state: state["extractor"])

        def detect(self, images: Tensor) -> list[Detection]:
            result = self._network(images, n=config.max_keypoints, pad_if_not_divisible=True)
            # whole pixels, counted from the first
            return [(each.keypoints + 0.5, each.descriptors, each.detection_scores) for each in result]

    return Disk(config, device)


EXTRACTORS = (Extractor("disk", DISK, _build, weights=_FILE, lightglue="disk"),)
