"""Planning with viewpoints: the map a planner queries, a local search without it, and views along a path."""

from wheretolook.planning.map_building import build_viewpoint_map, update_viewpoint_map
from wheretolook.planning.refine import RefinedViews, refine_directions, score_directions
from wheretolook.planning.sequences import (
    TurnLimit,
    ViewSequence,
    best_sequence,
    greedy_sequence,
    path_scores,
    resample_path,
)
from wheretolook.planning.viewpoint_map import MapOrigin, ViewChoice, ViewChoices, ViewpointMap

__all__ = [
    "MapOrigin",
    "RefinedViews",
    "TurnLimit",
    "ViewChoice",
    "ViewChoices",
    "ViewSequence",
    "ViewpointMap",
    "best_sequence",
    "build_viewpoint_map",
    "greedy_sequence",
    "path_scores",
    "refine_directions",
    "resample_path",
    "score_directions",
    "update_viewpoint_map",
]
