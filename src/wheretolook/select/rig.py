"""Rigs of cameras: read from a model or a file, and how probably they localize together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.camera_files import read_camera
from wheretolook.geometry.pose_files import poses_of_values
from wheretolook.geometry.pose_information import bearing_numbers
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.looks.selection import SetScoreModel
from wheretolook.mapping.colmap_model import read_model
from wheretolook.mapping.map import Map
from wheretolook.scorers.base import Scorer
from wheretolook.utils.errors import ConfigError, TableError, check_choice
from wheretolook.utils.files import read_yaml


class RigCamera(NamedTuple):
    """A camera of a rig, and its pose (3, 4) in the rig, in the unit of the map."""

    name: str
    camera: Camera
    cam_from_rig: Float


def read_rig(source: str | Path, opened: Map) -> list[RigCamera]:
    """Read the rig of a model by its rig_id, or a YAML file with `camera` and `cam_from_rig` of each camera by its name.

    Raises ConfigError if the model has no such rig, TableError if the file holds none.
    """
    if str(source).isdecimal():
        assert opened.path is not None
        rigs = read_model(opened.path).rigs
        number = int(str(source))
        check_choice("rig_id", number, rigs)
        rig = rigs[number]
        others = {sensor.id: pose.matrix() for sensor, pose in rig.non_ref_sensors.items()}
        poses = {rig.ref_sensor_id.id: np.eye(3, 4), **others}
        return [RigCamera(str(camera_id), opened.cameras[camera_id], pose) for camera_id, pose in poses.items()]
    try:
        return [
            RigCamera(str(name), read_camera(row["camera"]), poses_of_values(row["cam_from_rig"]))
            for name, row in read_yaml(Path(source)).items()
        ]
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ConfigError) as error:
        fix = "A line is: name: {camera: 'MODEL,width,height,parameters', cam_from_rig: [qw, qx, qy, qz, tx, ty, tz]}."
        raise TableError(f"this is no rig: {error!r}", path=source, fix=fix) from error


def rig_scores(scorers: Sequence[Scorer], cam_from_world: Float, scores: Float) -> tuple[float, float]:
    """Return the probabilities that at least one of N cameras localizes alone, and that all do jointly.

    Cameras that see the same landmarks fail together: in the order of their scores (N,), each counts by the share of its
    expected detections that no camera before has in view, and for the set score a landmark is detected as often as by the
    best of them. Poses are (N, 3, 4) in the world.
    """
    points = scorers[0].localization_map.landmarks.points
    p_detect = np.zeros((len(scorers), len(points)))
    precision = np.zeros(len(points))
    order = np.argsort(-scores, kind="stable")
    for n, row in enumerate(order):
        found = scorers[row].landmark_probabilities(cam_from_world[[row]])
        assert found is not None
        p_detect[n, found.rows] = found.p_detect
        precision[found.rows] = found.precision  # depends on the distance, nearly equal for all
    seen = np.flatnonzero(precision)
    p_detect = p_detect[:, seen]
    terms = bearing_numbers(points[seen] - camera_centers(cam_from_world).mean(axis=0)) * precision[seen, None]
    best = np.maximum.accumulate(p_detect)
    is_new = np.insert(best[:-1] == 0, 0, True, axis=0)
    share = (p_detect * is_new).sum(1) / np.maximum(p_detect.sum(1), 1e-9)
    p_none = float(np.prod((1 - scores[order]) ** share))
    sums = best[-1] @ np.column_stack([np.ones(len(seen)), terms])
    return 1 - p_none, float(SetScoreModel.bundled()(sums, np.array(p_none)))
