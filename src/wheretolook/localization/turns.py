"""Reads how the images of a rig were oriented relative to one another, from a table or odometry."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np
from scipy.spatial.transform import Rotation

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.io.poses import NAME_COLUMNS, QUATERNION_COLUMNS, NamedRows, poses_of_rows, read_named_rows
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import path_ends

MAX_STAMP_DIFFERENCE_S = 0.02  # between an image named by its time and its row of the odometry
BODY_UPRIGHT = 0.7  # z of a robot's own z axis in odometry, from which on it is no camera
CAM_FROM_BODY = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # a camera that looks along x of a body whose z is up


def read_turns(path: Path, images: Sequence[str]) -> Float:
    """Read cam_from_rig (N, 3, 4) of images, by their names; the rig's origin is the first image.

    The file has columns yaw and perhaps pitch and roll in degrees (yaw to the left, pitch upwards, roll clockwise), or qw,
    qx, qy, qz (camera-to-rig), and perhaps positions in metres; or is a TUM trajectory of the camera (z forward) or of
    a robot (x forward, z up) whose camera looks along x. Rows belong to the images of the same name, in the column
    image, or of the nearest time stamp, if images are named by their time. Otherwise they are in the order of the
    images, unless there is a column image.

    Raises TableError if the file cannot be read, an image has no row or several, or a row is no rotation.
    """
    table = read_named_rows(path)
    poses = _poses(table)
    poses = poses[_rows_of(table, [PurePath(name) for name in images])]
    centers = camera_centers(poses)
    poses[:, :, 3] = -np.einsum("nij,nj->ni", poses[:, :, :3], centers - centers[0])
    return poses


def _poses(table: NamedRows) -> Float:
    """Return cam_from_rig (R, 3, 4) of all rows."""
    if {*QUATERNION_COLUMNS} <= {*table.columns}:
        poses = poses_of_rows(table, orientations_only=True).cam_from_world
        of_body = table.header[0] == "t" and (poses[:, 2, 2] > BODY_UPRIGHT).all()
        return CAM_FROM_BODY @ poses if of_body else poses
    angles = np.zeros((len(table.rows), 3))
    for column, name in enumerate(("yaw", "pitch", "roll")):
        given = [known for known in (name, f"{name}_deg") if known in table.columns]
        if given:
            angles[:, column] = table.numbers(given[:1])[:, 0]
        elif name == "yaw":
            fix = "Give qw, qx, qy, qz, or yaw and perhaps pitch and roll in degrees."
            raise TableError("the columns state no rotation", path=table.path, value=",".join(table.header), fix=fix)
    rotated = Rotation.from_euler("xz", -angles[:, 1:], degrees=True).as_matrix() @ CAM_FROM_BODY
    rotations = rotated @ Rotation.from_euler("z", -angles[:, :1], degrees=True).as_matrix()
    return np.pad(rotations, ((0, 0), (0, 0), (0, 1)))


def _rows_of(table: NamedRows, images: Sequence[PurePath]) -> list[int]:
    """Return the row of each image: by name, by time, or in order."""
    is_named = any(name in table.columns for name in NAME_COLUMNS) and len({*table.names}) == len(table.names)
    rows = {name: row for row, name in enumerate(table.names)} if is_named else {}
    ends = [[*path_ends(path), path.stem] for path in images]
    found = [next((rows[name] for name in names if name in rows), None) for names in ends]
    if None in found and is_named:
        found = _rows_by_time(table, images) or found
    in_order = "image" not in table.columns and len(table.names) == len(images)
    if in_order and not any(row is not None for row in found):
        found = [*range(len(images))]
    for path, row in zip(images, found, strict=True):
        if row is None:
            fix = f"Name it once in the column image, or give {len(images)} rows in the order of the images."
            raise TableError("there is no rotation of this image", path=table.path, value=str(path), fix=fix)
    return [row for row in found if row is not None]


def _rows_by_time(table: NamedRows, images: Sequence[PurePath]) -> list[int | None]:
    """Return the row of the nearest time stamp of each image; empty if names are no times or one has no row."""
    try:
        stamps = np.array(table.names, dtype=float)
        times = np.array([path.stem for path in images], dtype=float)
    except ValueError:
        return []
    difference = np.abs(stamps - times[:, None])
    return difference.argmin(1).tolist() if (difference.min(1) <= MAX_STAMP_DIFFERENCE_S).all() else []
