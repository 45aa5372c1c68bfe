"""COLMAP maps: built from images rendered along a walk, or read from any COLMAP model."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wheretolook.mapping.building import MapReport, build_map
    from wheretolook.mapping.config import MapConfig
    from wheretolook.mapping.extraction import ExtractorConfig, KeypointExtractor, Keypoints
    from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
    from wheretolook.mapping.walk import Walk, WalkConfig, plan_walk

_HOME = {
    "ExtractorConfig": "extraction",
    "KeypointExtractor": "extraction",
    "Keypoints": "extraction",
    "Landmarks": "landmarks",
    "MapConfig": "config",
    "MapReport": "building",
    "Walk": "walk",
    "WalkConfig": "walk",
    "build_map": "building",
    "load_colmap_landmarks": "landmarks",
    "plan_walk": "walk",
}

__all__ = [
    "ExtractorConfig",
    "KeypointExtractor",
    "Keypoints",
    "Landmarks",
    "MapConfig",
    "MapReport",
    "Walk",
    "WalkConfig",
    "build_map",
    "load_colmap_landmarks",
    "plan_walk",
]


def __getattr__(name: str) -> Any:
    # On demand, so that the processes that extract keypoints need not load torch.
    if name in _HOME:
        return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
