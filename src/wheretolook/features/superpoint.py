"""SuperPoint (DeTone et al., CVPRW 2018), hloc's default: known from hloc's files, not extracted here."""

from __future__ import annotations

from wheretolook.features.descriptors import DescriptorKind
from wheretolook.features.extractor import Extractor

# hloc's "NN-superpoint" matches up to a distance of 0.7 between unit descriptors: 1 - 0.7^2 / 2
SUPERPOINT = DescriptorKind("superpoint", 256, "float16", min_similarity=0.755)

EXTRACTORS = (Extractor("superpoint", SUPERPOINT, lightglue="superpoint"),)
