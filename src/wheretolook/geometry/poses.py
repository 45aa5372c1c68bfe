"""Poses of cameras: transforms, centres, orientations, and the error between two.

Conventions: world in metres, z up. Camera x right, y down, z forward (OpenCV, COLMAP). Pixel (0.5, 0.5) is the centre
of the top-left pixel, as in COLMAP. Poses are `cam_from_world` matrices (..., 3, 4) in float64; quaternions are wxyz."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.utils.errors import PoseError

Float = NDArray[np.floating[Any]]

CUBE_FACES = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # ahead
    [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # right
    [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # left
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # down
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # up
    [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],  # behind
], dtype=np.float64)  # fmt: skip
"""Rotations face_from_camera (6, 3, 3) of the faces of a cube."""


def transform(cam_from_world: ArrayLike, points: ArrayLike) -> Float:
    """Apply poses (..., 3, 4) to points (N, 3). Returns (..., N, 3) in the target frame."""
    pose = np.asarray(cam_from_world, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ np.swapaxes(pose[..., :3], -1, -2) + pose[..., None, :, 3]


def invert_poses(poses: ArrayLike) -> Float:
    """Invert rigid transforms (..., 3, 4): cam_from_world to world_from_cam and back."""
    poses = np.asarray(poses, dtype=np.float64)
    rotation = np.swapaxes(poses[..., :3], -1, -2)
    return np.concatenate([rotation, -rotation @ poses[..., 3:]], axis=-1)


def compose_poses(b_to_c: ArrayLike, a_to_b: ArrayLike) -> Float:
    """Compose rigid transforms (..., 3, 4) to that from frame a to frame c."""
    second = np.asarray(b_to_c, dtype=np.float64)
    first = np.asarray(a_to_b, dtype=np.float64)
    rotation = second[..., :3]
    return np.concatenate([rotation @ first[..., :3], rotation @ first[..., 3:] + second[..., 3:]], axis=-1)


def camera_centers(cam_from_world: ArrayLike) -> Float:
    """Camera centres in the world, (..., 3) metres, of poses (..., 3, 4)."""
    return invert_poses(cam_from_world)[..., 3]


def split_poses(cam_from_world: ArrayLike) -> tuple[Float, Float]:
    """Rotations (..., 3, 3) and camera centres (..., 3) in metres of cam_from_world poses (..., 3, 4)."""
    poses = np.asarray(cam_from_world, dtype=np.float64)
    return poses[..., :3], camera_centers(poses)


def rotation_looking_along(directions: ArrayLike) -> Float:
    """cam_from_world rotations (..., 3, 3) of cameras that look along world directions (..., 3) and do not roll.

    The image's x axis is horizontal and its y axis points down as far as it can (world z is up). If a camera looks
    straight up or down, the image's x axis is the world's. Directions need not be of unit length. Raises PoseError if
    one has no length, or entries that are not finite.
    """
    forward = as_numbers(directions)
    length = np.linalg.norm(forward, axis=-1, keepdims=True)
    usable = (length > 0) & np.isfinite(length)
    if not usable.all():
        value = forward[~usable[..., 0]].reshape(-1, 3)[0].tolist()
        raise PoseError("a direction must be three finite numbers, not all zero", value=value)
    forward = forward / length
    right = np.stack([forward[..., 1], -forward[..., 0], np.zeros_like(forward[..., 0])], axis=-1)
    length = np.linalg.norm(right, axis=-1, keepdims=True)
    vertical = length < 1e-9
    right = np.where(vertical, (1.0, 0.0, 0.0), right / np.where(vertical, 1.0, length))
    return np.stack([right, np.cross(forward, right), forward], axis=-2)


def poses_looking_along(locations: ArrayLike, directions: ArrayLike) -> Float:
    """cam_from_world poses (..., 3, 4) of cameras at `locations` (..., 3) m looking along `directions` (..., 3).

    They are broadcast to each other. Raises PoseError if they cannot be, a location is not finite, or a direction is not
    or has no length.
    """
    at = as_numbers(locations)
    along = as_numbers(directions)
    try:
        shape = np.broadcast_shapes(at.shape, along.shape)
    except ValueError:
        shape = ()
    if {at.shape[-1:], along.shape[-1:], shape[-1:]} != {(3,)}:
        raise PoseError("as many locations (..., 3) as directions are needed", value=(at.shape, along.shape))
    rotation = rotation_looking_along(along)
    translation = -rotation @ check_locations(at)[..., None]
    return np.concatenate([np.broadcast_to(rotation, (*shape, 3)), translation], axis=-1)


def quaternion_from_rotation(rotation: ArrayLike) -> Float:
    """Unit quaternions wxyz (..., 4), w >= 0, of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    matrix = np.asarray(rotation, dtype=np.float64)
    quat = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_quat(canonical=True, scalar_first=True)
    return quat.reshape(*matrix.shape[:-2], 4)


def rotation_from_quaternion(quaternion_wxyz: ArrayLike) -> Float:
    """Rotation matrices (..., 3, 3) of quaternions wxyz (..., 4), normalized first."""
    from scipy.spatial.transform import Rotation

    quat = np.asarray(quaternion_wxyz, dtype=np.float64)
    matrix = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True).as_matrix()
    return matrix.reshape(*quat.shape[:-1], 3, 3)


def rotation_angle_deg(rotation_a: ArrayLike, rotation_b: ArrayLike) -> Float:
    """Angle of the rotation between (..., 3, 3) and (..., 3, 3), in degrees, in [0, 180].

    From |A - B|_F = 2 sqrt(2) sin(angle / 2), which is accurate at small angles, where arccos of the trace is not.
    """
    chord = np.linalg.norm(np.asarray(rotation_a) - np.asarray(rotation_b), axis=(-2, -1))
    return np.degrees(2 * np.arcsin(np.clip(chord / (2 * np.sqrt(2)), 0, 1)))


def pose_error(cam_from_world_a: ArrayLike, cam_from_world_b: ArrayLike) -> tuple[Float, Float]:
    """Distance between camera centres (m) and angle between orientations (deg) of two batches of poses (..., 3, 4).

    The error measure of the Long-Term Visual Localization benchmark (Sattler et al., CVPR 2018), which the paper uses.
    """
    a = np.asarray(cam_from_world_a, dtype=np.float64)
    b = np.asarray(cam_from_world_b, dtype=np.float64)
    error_m = np.linalg.norm(camera_centers(a) - camera_centers(b), axis=-1)
    return error_m, rotation_angle_deg(a[..., :3], b[..., :3])


def as_numbers(values: ArrayLike) -> NDArray[np.float64]:
    """Return values as float64. Raises PoseError for text, complex numbers and lists of different lengths."""
    try:
        return np.asarray(values).astype(np.float64, casting="same_kind", copy=False)
    except (TypeError, ValueError) as error:
        raise PoseError(f"these are no numbers: {error}") from error


def unit(vectors: Float) -> Float:
    """Return vectors (..., 3) scaled to unit length."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def angle_deg(cosine: ArrayLike) -> Float:
    """Return angles in degrees of cosines, which rounding may have moved beyond -1 or 1."""
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def as_points(values: ArrayLike) -> NDArray[np.float64]:
    """Return points as float64 (N, 3); one point (3,) is N = 1."""
    return np.asarray(values, dtype=np.float64).reshape(-1, 3)


def check_poses(cam_from_world: ArrayLike) -> NDArray[np.float64]:
    """The poses as float64 (B, 3, 4). Raises PoseError, a ValueError, on another shape or entries not finite or too large."""
    poses = as_numbers(cam_from_world)
    if poses.ndim != 3 or poses.shape[1:] != (3, 4):
        raise PoseError("cam_from_world must have shape (B, 3, 4)", value=poses.shape)
    invalid = np.flatnonzero(~(np.abs(poses) <= 1e12).all(axis=(1, 2)))
    if len(invalid):
        raise PoseError(f"pose {invalid[0]} has NaN, infinite or too large entries", value=poses[invalid[0]].tolist())
    return poses


def are_rotations(matrices: Float, tolerance: float = 1e-5) -> NDArray[np.bool_]:
    """Whether matrices R (..., 3, 3) are rotations: entries of R R^T are within a tolerance of 1 and 0, none is mirrored."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max((-2, -1))
        return np.asarray((off <= tolerance) & (np.linalg.det(matrices) > 0))


def rigid_poses(poses: ArrayLike) -> NDArray[np.float64]:
    """The poses (3, 4), (4, 4), (B, 3, 4) or (B, 4, 4) as float64 (B, 3, 4).

    Raises PoseError, as `check_poses`, and if one is no rigid transform.
    """
    matrices = as_numbers(poses)
    if matrices.ndim == 2:
        matrices = matrices[None]
    homogeneous = matrices.ndim == 3 and matrices.shape[1:] == (4, 4)
    checked = check_poses(matrices[:, :3] if homogeneous else matrices)
    rigid = are_rotations(checked[:, :, :3], 1e-3)
    if homogeneous:
        rigid &= (matrices[:, 3] == (0, 0, 0, 1)).all(1)
    for row in np.flatnonzero(~rigid):
        fix = "Give a rotation without scale and a translation, world to camera, and as a fourth row 0 0 0 1."
        raise PoseError(f"pose {row} is no rigid transform", value=matrices[row].tolist(), fix=fix)
    return checked


def check_locations(locations: ArrayLike) -> NDArray[np.float64]:
    """The locations as float64 (..., 3). Raises PoseError, a ValueError, on entries that are not finite."""
    at = as_numbers(locations)
    finite = np.isfinite(at).all(axis=-1)
    if not finite.all():
        raise PoseError("a camera's location is NaN or infinite", value=at[~finite].reshape(-1, 3)[0].tolist())
    return at


TOLERANCE_DEG = 1e-5  # angles may exceed a limit by this much, for rounding


def within(angles_deg: Float, limit_deg: float) -> NDArray[np.bool_]:
    """Which angles are at most the limit, up to rounding; raises a ValueError for one that is negative or NaN."""
    if not limit_deg >= 0:
        raise ValueError(f"a limit of an angle must be at least 0 degrees, got {limit_deg}")
    return np.asarray(angles_deg <= limit_deg + TOLERANCE_DEG)


def check_axis(axis: ArrayLike) -> Float:
    """An axis (3,) of any length as a unit vector; raises a ValueError if it is not finite or has no length."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    return rotation_looking_along((x, y, z))[2]


def pan_tilt_angles(axes: Float) -> tuple[Float, Float]:
    """Yaws (azimuths) and pitches (elevations) of unit axes (..., 3) in radians, (...,) each."""
    return np.arctan2(axes[..., 1], axes[..., 0]), np.arcsin(np.clip(axes[..., 2], -1, 1))


def pan_tilt_turns_deg(a: Float, b: Float) -> Float:
    """Angles (A, B) in degrees by which a pan-tilt head turns from axes (A, 3) to (B, 3), pan and tilt at even speed.

    The two axes of rotation are perpendicular, so an angle is the root of the sum of the squares of pan and tilt. It is
    never less than that of the direct rotation (`turns_deg`).
    """
    yaw_a, pitch_a = pan_tilt_angles(a)
    yaw_b, pitch_b = pan_tilt_angles(b)
    pan = np.abs(yaw_a[:, None] - yaw_b[None])
    return np.degrees(np.hypot(np.minimum(pan, 2 * np.pi - pan), pitch_a[:, None] - pitch_b[None]))


def angles_to_axis_deg(directions: Float, axis: Float) -> Float:
    """Angles (D,) in degrees between unit directions (D, 3) and a unit axis (3,), accurate at small angles too."""
    chord = np.linalg.norm(directions - axis, axis=-1)
    return np.degrees(2 * np.arcsin(np.minimum(chord / 2, 1)))


def turns_from_deg(current: ArrayLike, rotations: Float) -> Float:
    """Rotation angles (D,) in degrees from one orientation to others, cam_from_world (D, 3, 3).

    `current` is the axis (3,) of a camera without roll, or a cam_from_world rotation (3, 3). Raises ValueError if
    `current` has another shape, is not finite, no rotation, or an axis of no length.
    """
    given: Float = np.asarray(current, dtype=np.float64)
    if given.shape == (3,):
        given = rotation_looking_along(check_axis(given))
    if given.shape != (3, 3) or not are_rotations(given):
        raise ValueError(f"an orientation is an axis (3,) or a rotation (3, 3), got {given}")
    return _angles_deg(given.reshape(1, 9), rotations.reshape(-1, 9))[0]


def turns_deg(directions: Float) -> Float:
    """Rotation angles (D, D) in degrees between cameras without roll that look along directions (D, 3).

    They are angles of the whole camera's rotation, as in the Active Localization Benchmark (evaluate_plan.py): 40
    degrees of yaw count as 40 at every pitch, though the optical axis of a camera pitched by 60 degrees moves by 20.
    """
    rotations = rotation_looking_along(directions).reshape(-1, 9)
    angles = _angles_deg(rotations, rotations)
    np.fill_diagonal(angles, 0)
    return np.maximum(angles, angles.T)  # symmetric to the last bit


def _angles_deg(a: NDArray[Any], b: NDArray[Any]) -> Float:
    """Angles (A, B) between rotations (A, 9) and (B, 9), from |A - B|_F^2 = 6 - 2 <A, B> = 8 sin^2(angle / 2)."""
    square = np.clip((6 - 2 * (a @ b.T)) / 8, 0, 1)
    return np.degrees(2 * np.arcsin(np.sqrt(square)))
