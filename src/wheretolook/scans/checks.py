"""Check that depths and poses of a recording are in the same unit, and in metres."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, camera_centers, invert_poses
from wheretolook.scans.frames import SURVEY_STRIDE, RgbdFrames, evenly
from wheretolook.utils.errors import SceneError

DEPTH_M = (0.2, 20.0)
"""Plausible range of the median reading of a depth camera."""
_AGREE = 0.03  # relative difference of two depths of the same point that agree
_PAIRS = 40  # pairs of frames that are compared
_MIN_PAIRS = 3
_MIN_SHARED = 50  # readings that the two frames of a pair share
_FACING = np.cos(np.radians(40.0))  # largest angle between the optical axes of a pair
_FACTORS = np.logspace(-3, 3, 361)  # candidate factors of depth, in steps of 4 %
_MOST_READINGS = 1000  # of a frame, that are compared
_MIN_AGREEMENT = 0.2  # share of the readings below which poses and depths do not belong together
_CLEARLY = 0.15  # share of the readings by which another factor must agree better
_UNIT_OFF = 1.25  # smallest factor that is attributed to the unit
_LANDMARK_OFF = 1.1  # a factor between depths and landmarks


def check_depth_unit(frames: RgbdFrames) -> None:
    """Raise SceneError if depths are in another unit than poses or landmarks, or not in metres.

    Frames that share surface show it: readings of one, transformed into the other by the poses, agree with that one's
    readings only if depths and poses are in one unit. With a model, depths are compared with its landmarks.
    """
    scale = frames.depth_scale
    off = 1.0 if frames.model is None else landmark_factor(landmark_readings(frames, frames.model))
    factor = pose_factor(frames.survey_m, frames.camera, frames.cam_from_world)
    median_m = float(np.median(frames.survey_m[frames.survey_m > 0]))
    if not 1 / _LANDMARK_OFF < off < _LANDMARK_OFF:
        problem = f"the model's landmarks are {off:.3g} times as far as the depth images show"
        fix = f"Give the model metres (`wheretolook map --model`), or {_option(scale / off)} if its unit is one."
    elif np.isnan(factor):
        problem = "neighbouring frames do not show the same surfaces at their poses, whatever the unit of depth"
        fix = "Give poses world_from_cam (not cam_from_world), x right, y down, z forward, of the same frames."
    elif not 1 / _UNIT_OFF < factor < _UNIT_OFF:
        problem = f"depths seem to be {factor:.2g} times as large in the unit of the poses"
        fix = f"Give {_option(scale / factor)}, or poses in metres."
    elif not DEPTH_M[0] <= median_m <= DEPTH_M[1]:
        problem = f"depths seem not to be in metres: half of the readings are nearer than {median_m:.3g} m"
        fix = f"Give the units of a metre, such as {_option(5000 if scale < 5000 else 1000)}, and poses in metres."
    else:
        return
    raise SceneError(problem, path=frames.folder, value=f"{scale:g} units a metre", fix=fix)


def landmark_readings(frames: RgbdFrames, model: Any) -> Float:
    """Depths of a model's landmarks in the frames that observe them, and the readings there, (N, 2).

    Takes the `pycolmap.Reconstruction` that gave the poses.
    """
    pairs = [np.zeros((0, 2))]
    by_name = {image.name: image for image in model.images.values()}
    for name, survey_m, pose in zip(frames.names_in_model, frames.survey_m, frames.cam_from_world, strict=True):
        points = [model.points3D[p.point3D_id].xyz for p in by_name[name].points2D if p.has_point3D()]
        in_camera = np.reshape(points, (-1, 3)) @ pose[:, :3].T + pose[:, 3]
        readings = _readings_at(survey_m, frames.camera, in_camera)
        pairs.append(np.column_stack([in_camera[:, 2], readings])[np.isfinite(readings)])
    return np.concatenate(pairs)


def landmark_factor(readings: Float) -> float:
    """Median ratio of the depth of landmarks to the readings there, of (N, 2); 1 for fewer than 20."""
    return float(np.median(readings[:, 0] / readings[:, 1])) if len(readings) >= 20 else 1.0


def pose_factor(survey_m: NDArray[np.float32], camera: PinholeCamera, cam_from_world: Float) -> float:
    """Factor of depths (F, h, w) at which neighbouring frames agree; 1 unless another is clearly better.

    NaN if hardly any readings agree at any factor; 1 if the camera moved too little.
    """
    agreements = []
    for i, j in _pairs(cam_from_world):
        row, column = np.nonzero(survey_m[i])
        chosen = evenly(len(row), _MOST_READINGS)
        pixels = np.column_stack([column, row])[chosen] * SURVEY_STRIDE + SURVEY_STRIDE // 2 + 0.5
        rays = camera.unproject(pixels)
        points = rays / rays[:, 2:] * survey_m[i][row, column][chosen, None]
        relative = cam_from_world[j] @ np.vstack([invert_poses(cam_from_world[i]), (0, 0, 0, 1)])
        # scaling the depths of both frames by a factor is the same as dividing the translation by it
        moved = points @ relative[:, :3].T + relative[:, 3] / _FACTORS[:, None, None]
        there = _readings_at(survey_m[j], camera, moved)  # (factors, readings)
        n_shared = np.isfinite(there).sum(1)
        n_agree = (np.abs(moved[..., 2] - there) < _AGREE * there).sum(1)
        agreements.append(np.where(n_shared >= _MIN_SHARED, n_agree / np.maximum(n_shared, 1), 0.0))
    if len(agreements) < _MIN_PAIRS:
        return 1.0
    agreement = np.mean(agreements, axis=0)
    best = int(agreement.argmax())
    near_one = agreement[np.abs(np.log(_FACTORS)) < np.log(_UNIT_OFF)].max()
    if agreement[best] < _MIN_AGREEMENT:
        return float("nan")
    return float(_FACTORS[best]) if agreement[best] > near_one + _CLEARLY else 1.0


def _pairs(cam_from_world: Float) -> list[tuple[int, int]]:
    """Pairs of frames with similar directions and typical distances."""
    centers = camera_centers(cam_from_world)
    axes = cam_from_world[:, 2, :3]
    first = evenly(len(centers), _PAIRS)
    apart = np.linalg.norm(centers[first][:, None] - centers, axis=-1)
    facing = axes[first] @ axes.T > _FACING
    if not (apart[facing] > 0).any():
        return []
    wanted = np.median(apart[facing & (apart > 0)])
    off = np.where(facing & (apart > 0.2 * wanted), np.abs(apart - wanted), np.inf)
    partner = off.argmin(1)
    return [(int(i), int(j)) for i, j, row in zip(first, partner, off, strict=True) if np.isfinite(row[j])]


def _readings_at(survey_m: NDArray[np.float32], camera: PinholeCamera, points_cam: Float) -> Float:
    """A survey's readings (...) at points (..., 3) in its camera; NaN where there is none."""
    pixels = camera.project(points_cam)
    inside = (points_cam[..., 2] > 0) & camera.in_image(pixels)
    column, row = (pixels[inside] // SURVEY_STRIDE).astype(np.int64).T
    height, width = survey_m.shape
    readings = np.full(inside.shape, np.nan)
    readings[inside] = survey_m[np.minimum(row, height - 1), np.minimum(column, width - 1)]
    readings[readings == 0] = np.nan
    return readings


def _option(scale: float) -> str:
    return f"--scenes.rgbd.depth_scale {scale:.4g}"
