"""Rigs of cameras: read from a model or a file, and how probably they localize together."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

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

    Files of cameras are searched next to the rig's file first. Raises ConfigError if the model has no such rig, TableError
    if the rig has no camera, or one without a pose.
    """
    cameras = _rig_of_model(int(str(source)), opened) if str(source).isdecimal() else _rig_of_file(Path(source))
    if not cameras:
        raise TableError("the rig has no camera", path=source)
    return cameras


def _rig_of_model(number: int, opened: Map) -> list[RigCamera]:
    assert opened.path is not None
    rigs = read_model(opened.path).rigs
    check_choice("rig_id", number, rigs)
    reference = rigs[number].ref_sensor_id
    cameras = []
    for sensor, pose in {reference: pycolmap.Rigid3d(), **rigs[number].non_ref_sensors}.items():
        if sensor.type != pycolmap.SensorType.CAMERA:
            continue
        if pose is None:
            fix = "Calibrate the rig by COLMAP's rig_configurator, or give a file of the rig."
            raise TableError(f"sensor {sensor.id} has no pose in the rig", path=opened.path, value=number, fix=fix)
        cameras.append(RigCamera(str(sensor.id), opened.cameras[sensor.id], pose.matrix()))
    return cameras


def _rig_of_file(path: Path) -> list[RigCamera]:
    cameras = []
    try:
        for name, row in read_yaml(path).items():
            relative = os.path.join(path.parent, row["camera"])
            camera = read_camera(relative if os.path.isfile(relative) else row["camera"])
            cameras.append(RigCamera(str(name), camera, poses_of_values(row["cam_from_rig"])))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ConfigError) as error:
        fix = "A line is: name: {camera: 'MODEL,width,height,parameters', cam_from_rig: [qw, qx, qy, qz, tx, ty, tz]}."
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise TableError(f"this is no rig: {reason}", path=path, fix=fix) from error
    return cameras


def rig_scores(scorers: Sequence[Scorer], cam_from_world: Float, scores: Float) -> tuple[float, float]:
    """Return the probabilities that at least one of N cameras localizes alone, and that all do jointly.

    Cameras that see the same landmarks fail together: in the order of their scores (N,), each counts by the share of its
    expected detections that no camera before has in view, and for the set score a landmark is detected as often as by the
    best of them. Neither is below the best score; of one camera both are its score. Poses are (N, 3, 4) in the world.
    """
    best_score = float(scores.max())
    if len(scores) == 1:
        return best_score, best_score
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
    set_score = float(SetScoreModel.bundled()(sums, np.array(p_none)))
    return max(1 - p_none, best_score), max(set_score, best_score)
