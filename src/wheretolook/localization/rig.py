"""Views of one rig: their rotations and offsets, how they are read, and a prior of their pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from wheretolook.features.matches import Matches, is_twin
from wheretolook.geometry.camera import Camera, field_of_view_deg, scale_focal
from wheretolook.geometry.pose_files import (
    CAM_FROM_BASE,
    NAME_COLUMNS,
    QUATERNION_COLUMNS,
    NamedRows,
    is_of_base,
    poses_of_rows,
    read_named_rows,
)
from wheretolook.geometry.poses import (
    Float,
    are_rotations,
    as_numbers,
    camera_centers,
    compose_poses,
    invert_poses,
    rigid_poses,
)
from wheretolook.geometry.similarity import Similarity
from wheretolook.utils.errors import ConfigError, PoseError, TableError
from wheretolook.utils.files import path_ends

IDENTITY: Float = np.eye(3, 4)

MAX_NEAREST_RATIO = 1.15
"""Maximum ratio of the descriptor distances to a candidate and to the nearest landmark of the map."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Landmarks whose descriptors are about as near to a keypoint's as the nearest of the map, sorted by their distances.

    Attributes:
        keypoints: (M,) rows of an image's keypoints.
        pixels: (M, 2) their pixels.
        landmarks: (M,) rows of their candidates.
    """

    keypoints: NDArray[np.int64]
    pixels: Float
    landmarks: NDArray[np.int64]

    @classmethod
    def of(cls, pixels: Float, matches: Matches) -> Candidates:
        """Select from the nearest landmarks of keypoints at pixels (K, 2)."""
        keypoints, columns = np.nonzero(matches.squared <= MAX_NEAREST_RATIO**2 * matches.squared[:, :1])
        order = np.argsort(matches.squared[keypoints, columns], kind="stable")
        keypoints = keypoints[order]
        return cls(keypoints, pixels[keypoints], matches.near[keypoints, columns[order]])


@dataclass(frozen=True)
class FocalPrior:
    """What is assumed of a focal length: it is one of some values, or any other in a range.

    Attributes:
        focal_px: (K,) values, in pixels.
        deviations: (K,) one standard deviation of the log of each: 0 for that of a mapping camera, which is the same or
            another one; EXIF data are rounded.
        p_any: probability of any other focal length, from the smallest value / `span` to the largest times `span`.
        common: ratio of the error of an estimated focal length to its deviation by independent keypoints, since landmarks
            and the lens err alike for many: up to 2 for most photographs of cameras, 7 for a film by a phone.
    """

    focal_px: tuple[float, ...]
    deviations: tuple[float, ...]
    p_any: float = 0.5
    span: float = 1.6
    common: float = 3.0

    @property
    def log_range(self) -> tuple[float, float]:
        """Logs of the smallest and the largest focal length."""
        return float(np.log(min(self.focal_px) / self.span)), float(np.log(max(self.focal_px) * self.span))

    def allows(self, camera: Camera) -> bool:
        """Whether a camera's focal length is in the range."""
        low, high = self.log_range
        return bool(low <= np.log(camera.mean_focal_px) <= high)

    def posterior(self, log_focal: float, variance: float) -> tuple[float, float]:
        """Return the log of the most probable focal length, and the mean squared error of this log.

        Takes the log as estimated from an image, with its variance by independent keypoints.
        """
        variance = variance * self.common**2
        low, high = self.log_range
        prior = np.square([*self.deviations])
        total = prior + variance
        error = log_focal - np.log(self.focal_px)
        density = np.exp(-(error**2) / (2 * total)) / np.sqrt(2 * np.pi * total)
        weights = np.append(density * (1 - self.p_any) / len(total), self.p_any / (high - low))
        weights /= weights.sum()
        # of each component: mean and variance given the estimate
        means = np.append(np.log(self.focal_px) + error * prior / total, np.clip(log_focal, low, high))
        variances = np.append(prior * variance / total, min(variance, (high - low) ** 2 / 12))
        mean = float(means[np.argmax(weights)])
        return mean, float(weights @ (variances + (means - mean) ** 2))


@dataclass(frozen=True, eq=False)
class Look:
    """The matches of one view of a rig.

    Raises PoseError if the pose in the rig is not rigid, or pixels and rows differ in number.
    """

    cam_from_rig: Float  # (3, 4) metres
    pixels: Float  # (M, 2) in its image
    rows: NDArray[np.int64]  # (M,) of the landmarks
    camera: Camera
    candidates: Candidates | None = None  # for all its keypoints, if they are to be matched again under each hypothesis
    focal: FocalPrior | None = None  # None if the camera is known; otherwise its focal length is refined with the pose

    @classmethod
    def of(
        cls,
        pixels: Float,
        matches: Matches,
        camera: Camera,
        cam_from_rig: Float = IDENTITY,
        focal: FocalPrior | None = None,
    ) -> Look:
        """Combine the matches of an image with their candidates, from the pixels (K, 2) of all its keypoints."""
        at: Float = np.asarray(pixels, dtype=np.float64)
        candidates = Candidates.of(at, matches)
        return cls(cam_from_rig, at[matches.keypoints], matches.landmarks, camera, candidates, focal)

    def scaled(self, ratio: float) -> Look:
        """Return the view with its focal length, if that is assumed, multiplied by a ratio."""
        return self if self.focal is None else replace(self, camera=scale_focal(self.camera, ratio))

    def __post_init__(self) -> None:
        if not are_rotations(self.cam_from_rig[:, :3]):
            raise PoseError("the pose of a view in the rig is not rigid", value=self.cam_from_rig.tolist())
        if np.shape(self.pixels) != (len(self.rows), 2):
            value = (np.shape(self.pixels), len(self.rows))
            raise PoseError("a view needs a pixel (x, y) for each row of a landmark", value=value)


def checked_turns(turns: ArrayLike, n_views: int) -> Float:
    """Return rotations (N, 3, 3) or poses (N, 3, 4) of cameras in a rig as exactly rigid poses (N, 3, 4).

    Raises PoseError if one is not rigid, or there are more or fewer than views.
    """
    poses = as_numbers(turns)
    if poses.shape[1:] == (3, 3):
        poses = np.pad(poses, ((0, 0), (0, 0), (0, 1)))
    poses = rigid_poses(poses)
    if len(poses) != n_views:
        raise PoseError("each view needs a rotation", value=f"{len(poses)} rotations of {n_views} views")
    poses[:, :, :3] = Rotation.from_matrix(poses[:, :, :3]).as_matrix()  # of rounded numbers
    return poses


def rig_of(cam_from_world: Float) -> Float:
    """cam_from_rig (N, 3, 4) of views (N, 3, 4) from one location; the rig has the axes of the first view.

    Raises PoseError if a view is elsewhere than the first.
    """
    centers = camera_centers(cam_from_world)
    distance = np.linalg.norm(centers - centers[0], axis=1)
    if distance.max() > 1e-6:
        raise PoseError("these views are not from one location", value=f"{distance.max():.3g} m apart")
    cam_from_rig = compose_poses(cam_from_world, invert_poses(cam_from_world[0]))
    cam_from_rig[:, :, 3] = 0
    return cam_from_rig


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
        poses = poses_of_rows(table, orientations_only=True)
        of_base = table.header[0] in ("t", "timestamp") and is_of_base(table, poses)
        return CAM_FROM_BASE @ poses if of_base else poses
    angles = np.zeros((len(table.rows), 3))
    for column, name in enumerate(("yaw", "pitch", "roll")):
        given = [known for known in (name, f"{name}_deg") if known in table.columns]
        if given:
            angles[:, column] = table.numbers(given[:1])[:, 0]
        elif name == "yaw":
            fix = "Give qw, qx, qy, qz, or yaw and perhaps pitch and roll in degrees."
            raise TableError("the columns state no rotation", path=table.path, value=",".join(table.header), fix=fix)
    rotated = Rotation.from_euler("xz", -angles[:, 1:], degrees=True).as_matrix() @ CAM_FROM_BASE
    rotations = rotated @ Rotation.from_euler("z", -angles[:, :1], degrees=True).as_matrix()
    return np.pad(rotations, ((0, 0), (0, 0), (0, 1)))


def _rows_of(table: NamedRows, images: Sequence[PurePath]) -> list[int]:
    """Return the row of each image: by name, by time, or in order."""
    is_named = any(name in table.columns for name in NAME_COLUMNS) and len({*table.names}) == len(table.names)
    rows = {name: row for row, name in enumerate(table.names)} if is_named else {}
    found: list[int | None] = []
    for path in images:
        named = [rows[name] for name in (*path_ends(path), path.stem) if name in rows]
        found.append(named[0] if named else None)
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
    return difference.argmin(1).tolist() if (difference.min(1) <= 0.02).all() else []  # seconds


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A rough location (3,) m in the world of the map, and the yaw of an image in degrees, if known."""

    location: Float
    yaw_deg: float | None = None

    @classmethod
    def of(cls, values: Sequence[float], world_from_map: Similarity) -> PosePrior:
        """Convert x, y, z and perhaps yaw in the map. Raises ConfigError unless they are finite numbers."""
        try:
            numbers = as_numbers(values)
        except PoseError:
            numbers = np.zeros(0)
        if numbers.shape not in ((3,), (4,)) or not np.isfinite(numbers).all():
            fix = "Give x,y,z in the map, and perhaps the yaw in degrees."
            raise ConfigError("this is no prior of the pose", value=values, fix=fix)
        return cls(world_from_map.apply(numbers[:3]), float(numbers[3]) if len(numbers) == 4 else None)

    def allows(self, points: Float, mapping_distance_m: Float, camera: Camera) -> NDArray[np.bool_]:
        """Return which landmarks, points (N, 3) m, the camera may detect from near the prior, whatever its pitch."""
        offset: Float = points - self.location
        allowed = np.linalg.norm(offset, axis=1) <= 2.0 * mapping_distance_m  # farther ones are hardly detected
        if self.yaw_deg is not None:
            angle = np.degrees(np.arctan2(offset[:, 1], offset[:, 0])) - self.yaw_deg
            limit = max(field_of_view_deg(camera)) / 2 + 30.0  # degrees that the yaw may be off
            allowed &= np.abs((angle + 180) % 360 - 180) <= limit
        return np.asarray(allowed)


def matches_among(
    matches: Matches, allowed: NDArray[np.bool_], max_ratio: float | None, twins: NDArray[np.uint8] | None = None
) -> Matches:
    """Match keypoints again with the allowed (N,) of their nearest landmarks.

    With a maximum ratio, the nearest allowed landmark is compared with the second nearest allowed one, or with the last
    of the nearest if there is none; not with a twin, as `match`. A landmark keeps its nearest keypoint.
    """
    near = allowed[matches.near]
    keypoints = np.flatnonzero(near.any(axis=1))
    near = near[keypoints]
    squared = matches.squared[keypoints]
    rows = np.arange(len(keypoints))
    first = near.argmax(axis=1)
    near[rows, first] = False
    if twins is not None:
        near &= ~is_twin(matches.near[keypoints], matches.near[keypoints, first], twins)
    second = np.where(near.any(axis=1), near.argmax(axis=1), near.shape[1] - 1)
    distance = squared[rows, first]
    if max_ratio is not None:
        rows = np.flatnonzero(distance < max_ratio**2 * squared[rows, second])
    landmarks = matches.near[keypoints, first]
    rows = rows[np.argsort(distance[rows], kind="stable")]
    rows = np.sort(rows[np.unique(landmarks[rows], return_index=True)[1]])
    return matches._replace(keypoints=keypoints[rows], landmarks=landmarks[rows])
