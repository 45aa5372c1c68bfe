"""COLMAP maps: built from images rendered along a walk or from photographs, or read from any COLMAP model."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wheretolook.mapping.building import MapReport, build_map
    from wheretolook.mapping.config import MapConfig
    from wheretolook.mapping.extraction import ExtractorConfig, KeypointExtractor, Keypoints
    from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
    from wheretolook.mapping.photograph_config import KnownDistance, PhotographsConfig, ScaleConfig
    from wheretolook.mapping.photograph_map import PhotographMapReport, map_photographs
    from wheretolook.mapping.walk import Walk, WalkConfig, plan_walk

_HOME = {
    "ExtractorConfig": "extraction",
    "KeypointExtractor": "extraction",
    "Keypoints": "extraction",
    "KnownDistance": "photograph_config",
    "Landmarks": "landmarks",
    "MapConfig": "config",
    "MapReport": "building",
    "PhotographMapReport": "photograph_map",
    "PhotographsConfig": "photograph_config",
    "ScaleConfig": "photograph_config",
    "Walk": "walk",
    "WalkConfig": "walk",
    "build_map": "building",
    "load_colmap_landmarks": "landmarks",
    "map_photographs": "photograph_map",
    "plan_walk": "walk",
}

__all__ = [
    "ExtractorConfig",
    "KeypointExtractor",
    "Keypoints",
    "KnownDistance",
    "Landmarks",
    "MapConfig",
    "MapReport",
    "PhotographMapReport",
    "PhotographsConfig",
    "ScaleConfig",
    "Walk",
    "WalkConfig",
    "build_map",
    "load_colmap_landmarks",
    "map_photographs",
    "plan_walk",
]


def __getattr__(name: str) -> Any:
    # On demand, so that the processes that extract keypoints need not load torch.
    if name in _HOME:
        return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
