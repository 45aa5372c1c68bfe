"""Which landmarks a viewpoint sees: not occluded (a matter of the location alone) and inside the camera's view."""

from wheretolook.visibility.counting import FrustumCounter, count_plain
from wheretolook.visibility.device_points import DevicePoints
from wheretolook.visibility.frustum import VisibleSets, visible_landmarks
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion, OcclusionModel, StoredOcclusion
from wheretolook.visibility.survey import Survey, survey

__all__ = [
    "DevicePoints",
    "FrustumCounter",
    "HiddenPointRemoval",
    "MeshOcclusion",
    "NoOcclusion",
    "OcclusionModel",
    "StoredOcclusion",
    "Survey",
    "VisibleSets",
    "count_plain",
    "survey",
    "visible_landmarks",
]
