"""wheretolook: where to point a camera so that it knows where it is.

`WhereToLook` finds the best views at places of any COLMAP model. `LocalizationMap.from_colmap`, `load_scorer` and
`poses_looking_along` score viewpoints of one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wheretolook.utils.package import VERSION as __version__

if TYPE_CHECKING:
    from wheretolook.geometry.camera import PinholeCamera
    from wheretolook.geometry.poses import poses_looking_along
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.mapping.map import Map
    from wheretolook.planning.viewpoint_map import ViewpointMap
    from wheretolook.scorers.weights import load_scorer
    from wheretolook.select.where_to_look import WhereToLook

__all__ = [
    "LocalizationMap",
    "Map",
    "PinholeCamera",
    "ViewpointMap",
    "WhereToLook",
    "__version__",
    "load_scorer",
    "poses_looking_along",
]

_HOMES = {
    "LocalizationMap": "wheretolook.inputs.localization_map",
    "Map": "wheretolook.mapping.map",
    "PinholeCamera": "wheretolook.geometry.camera",
    "load_scorer": "wheretolook.scorers.weights",
    "ViewpointMap": "wheretolook.planning.viewpoint_map",
    "WhereToLook": "wheretolook.select.where_to_look",
    "poses_looking_along": "wheretolook.geometry.poses",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:  # loads PyTorch and Warp
        from importlib import import_module

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
