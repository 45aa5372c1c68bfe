"""wheretolook: where to point a camera so that it knows where it is.

`WhereToLook` finds the best views at places of any COLMAP model. `LocalizationMap.from_colmap`, `load_scorer` and
`poses_looking_along` score viewpoints of one.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from wheretolook.utils.package import VERSION as __version__

if TYPE_CHECKING:
    from wheretolook.dataset.sampling import free_locations as free_locations
    from wheretolook.geometry.camera import (
        ColmapCamera as ColmapCamera,
        PinholeCamera as PinholeCamera,
        camera_of as camera_of,
    )
    from wheretolook.geometry.lattices import VoxelGrid as VoxelGrid, fibonacci_sphere as fibonacci_sphere
    from wheretolook.geometry.poses import (
        camera_centers as camera_centers,
        check_poses as check_poses,
        poses_looking_along as poses_looking_along,
    )
    from wheretolook.geometry.tsdf import DepthImage as DepthImage, TsdfVolume as TsdfVolume
    from wheretolook.geometry.views import Views as Views
    from wheretolook.inputs.localization_map import LocalizationMap as LocalizationMap
    from wheretolook.mapping.config import FrameOptions as FrameOptions
    from wheretolook.mapping.depth_images import read_depth_images as read_depth_images
    from wheretolook.mapping.map import Map as Map
    from wheretolook.mapping.map_frame import MapFrame as MapFrame
    from wheretolook.planning.config import PathConfig as PathConfig
    from wheretolook.planning.routes import PlannedPath as PlannedPath
    from wheretolook.planning.rrt import plan_path as plan_path
    from wheretolook.planning.scene_map import build_viewpoint_map as build_viewpoint_map
    from wheretolook.planning.stops import refine_directions as refine_directions
    from wheretolook.planning.view_sequence import ViewSequence as ViewSequence, best_sequence as best_sequence
    from wheretolook.planning.viewpoint_map import ViewpointMap as ViewpointMap
    from wheretolook.scorers.base import CountingScorer as CountingScorer, Scorer as Scorer
    from wheretolook.scorers.registry import (
        Learner as Learner,
        Method as Method,
        describe_methods as describe_methods,
        make_scorer as make_scorer,
    )
    from wheretolook.scorers.set.accuracy import AccuracyModel as AccuracyModel
    from wheretolook.scorers.weights import (
        load_scorer as load_scorer,
        resolve_weights as resolve_weights,
        weights_by_method as weights_by_method,
    )
    from wheretolook.select.localized import Localized as Localized
    from wheretolook.select.waypoints import (
        Waypoints as Waypoints,
        parse_points as parse_points,
        read_waypoints as read_waypoints,
    )
    from wheretolook.select.where_to_look import WhereToLook as WhereToLook
    from wheretolook.utils.errors import (
        CameraError as CameraError,
        ConfigError as ConfigError,
        InUseError as InUseError,
        LockWarning as LockWarning,
        MapError as MapError,
        MapFormatError as MapFormatError,
        MapWarning as MapWarning,
        MissingRunError as MissingRunError,
        OutOfRangeWarning as OutOfRangeWarning,
        PlanningError as PlanningError,
        PoseError as PoseError,
        SceneError as SceneError,
        StorageError as StorageError,
        TableError as TableError,
        TrackingError as TrackingError,
        TrackingWarning as TrackingWarning,
        WeightsError as WeightsError,
        WhereToLookError as WhereToLookError,
        WorkerError as WorkerError,
    )
    from wheretolook.visibility.hidden_points import HiddenPointRemoval as HiddenPointRemoval
    from wheretolook.visibility.occlusion import (
        MeshOcclusion as MeshOcclusion,
        NoOcclusion as NoOcclusion,
        OcclusionModel as OcclusionModel,
        TsdfOcclusion as TsdfOcclusion,
    )

_NAMES = {
    "select.where_to_look": "WhereToLook",
    "select.localized": "Localized",
    "select.waypoints": "Waypoints parse_points read_waypoints",
    "geometry.views": "Views",
    "inputs.localization_map": "LocalizationMap",
    "mapping.map": "Map",
    "mapping.config": "FrameOptions",
    "mapping.map_frame": "MapFrame",
    "mapping.depth_images": "read_depth_images",
    "geometry.camera": "ColmapCamera PinholeCamera camera_of",
    "geometry.poses": "camera_centers check_poses poses_looking_along",
    "geometry.lattices": "VoxelGrid fibonacci_sphere",
    "geometry.tsdf": "DepthImage TsdfVolume",
    "scorers.registry": "Learner Method describe_methods make_scorer",
    "scorers.weights": "load_scorer resolve_weights weights_by_method",
    "scorers.base": "CountingScorer Scorer",
    "scorers.set.accuracy": "AccuracyModel",
    "visibility.occlusion": "MeshOcclusion NoOcclusion OcclusionModel TsdfOcclusion",
    "visibility.hidden_points": "HiddenPointRemoval",
    "dataset.sampling": "free_locations",
    "planning.viewpoint_map": "ViewpointMap",
    "planning.scene_map": "build_viewpoint_map",
    "planning.rrt": "plan_path",
    "planning.config": "PathConfig",
    "planning.routes": "PlannedPath",
    "planning.view_sequence": "ViewSequence best_sequence",
    "planning.stops": "refine_directions",
    "utils.errors": "CameraError ConfigError InUseError LockWarning MapError MapFormatError MapWarning MissingRunError OutOfRangeWarning PlanningError PoseError SceneError StorageError TableError TrackingError TrackingWarning WeightsError WhereToLookError WorkerError",
}
"""The public names by their modules, which docs/api.md describes."""

_HOMES = {name: f"wheretolook.{module}" for module, names in _NAMES.items() for name in names.split()}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name in _HOMES:  # loads PyTorch and Warp
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
