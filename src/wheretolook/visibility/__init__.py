"""Which landmarks a viewpoint sees: not occluded (a matter of the location alone) and inside the frustum."""

from wheretolook.visibility.frustum import VisibleSets, count_in_frustum
from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion, OcclusionModel, StoredOcclusion

__all__ = ["MeshOcclusion", "NoOcclusion", "OcclusionModel", "StoredOcclusion", "VisibleSets", "count_in_frustum"]
