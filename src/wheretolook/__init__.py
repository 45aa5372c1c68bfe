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
    from wheretolook.geometry.camera import ColmapCamera as ColmapCamera
    from wheretolook.geometry.camera import PinholeCamera as PinholeCamera
    from wheretolook.geometry.camera import camera_of as camera_of
    from wheretolook.geometry.lattices import VoxelGrid as VoxelGrid
    from wheretolook.geometry.lattices import fibonacci_sphere as fibonacci_sphere
    from wheretolook.geometry.poses import camera_centers as camera_centers
    from wheretolook.geometry.poses import check_poses as check_poses
    from wheretolook.geometry.poses import poses_looking_along as poses_looking_along
    from wheretolook.geometry.tsdf import DepthImage as DepthImage
    from wheretolook.geometry.tsdf import TsdfVolume as TsdfVolume
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
    from wheretolook.planning.view_sequence import ViewSequence as ViewSequence
    from wheretolook.planning.view_sequence import best_sequence as best_sequence
    from wheretolook.planning.viewpoint_map import ViewpointMap as ViewpointMap
    from wheretolook.scorers.base import CountingScorer as CountingScorer
    from wheretolook.scorers.base import Scorer as Scorer
    from wheretolook.scorers.registry import Learner as Learner
    from wheretolook.scorers.registry import Method as Method
    from wheretolook.scorers.registry import describe_methods as describe_methods
    from wheretolook.scorers.registry import make_scorer as make_scorer
    from wheretolook.scorers.set.accuracy import AccuracyModel as AccuracyModel
    from wheretolook.scorers.weights import load_scorer as load_scorer
    from wheretolook.scorers.weights import resolve_weights as resolve_weights
    from wheretolook.scorers.weights import weights_by_method as weights_by_method
    from wheretolook.select.localized import Localized as Localized
    from wheretolook.select.waypoints import Waypoints as Waypoints
    from wheretolook.select.waypoints import parse_points as parse_points
    from wheretolook.select.waypoints import read_waypoints as read_waypoints
    from wheretolook.select.where_to_look import WhereToLook as WhereToLook
    from wheretolook.utils.errors import CameraError as CameraError
    from wheretolook.utils.errors import ConfigError as ConfigError
    from wheretolook.utils.errors import InUseError as InUseError
    from wheretolook.utils.errors import LockWarning as LockWarning
    from wheretolook.utils.errors import MapError as MapError
    from wheretolook.utils.errors import MapFormatError as MapFormatError
    from wheretolook.utils.errors import MapWarning as MapWarning
    from wheretolook.utils.errors import MissingRunError as MissingRunError
    from wheretolook.utils.errors import OutOfRangeWarning as OutOfRangeWarning
    from wheretolook.utils.errors import PlanningError as PlanningError
    from wheretolook.utils.errors import PoseError as PoseError
    from wheretolook.utils.errors import SceneError as SceneError
    from wheretolook.utils.errors import StorageError as StorageError
    from wheretolook.utils.errors import TableError as TableError
    from wheretolook.utils.errors import TrackingError as TrackingError
    from wheretolook.utils.errors import TrackingWarning as TrackingWarning
    from wheretolook.utils.errors import WeightsError as WeightsError
    from wheretolook.utils.errors import WhereToLookError as WhereToLookError
    from wheretolook.utils.errors import WorkerError as WorkerError
    from wheretolook.visibility.hidden_points import HiddenPointRemoval as HiddenPointRemoval
    from wheretolook.visibility.occlusion import MeshOcclusion as MeshOcclusion
    from wheretolook.visibility.occlusion import NoOcclusion as NoOcclusion
    from wheretolook.visibility.occlusion import OcclusionModel as OcclusionModel
    from wheretolook.visibility.occlusion import TsdfOcclusion as TsdfOcclusion

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
