"""Converts ROS messages to arrays and back.

Poses are matrices (3, 4). ROS puts pixel (0, 0) at the centre of the top-left pixel, wheretolook (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3, Vector3Stamped
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

Array = NDArray[Any]

REC_709 = np.array((0.2126, 0.7152, 0.0722), dtype=np.float32)  # weights of red, green and blue, as in the maps
BAYERS = {
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}
BYTES = {"mono8": 1, "mono16": 2, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4} | dict.fromkeys(BAYERS, 1)  # of a pixel
UNDISTORT: dict[str, Any] = {
    "plumb_bob": cv2.undistortPoints,
    "rational_polynomial": cv2.undistortPoints,
    "equidistant": cv2.fisheye.undistortPoints,
}


def seconds(stamp: Time) -> float:
    """Convert a stamp to seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def grey_image(message: Image | CompressedImage) -> NDArray[np.uint8]:
    """Convert an image to grey (H, W) uint8. Raises ValueError for an encoding or a size that cannot be used."""
    if isinstance(message, CompressedImage):
        decoded = cv2.imdecode(np.frombuffer(message.data, dtype=np.uint8), cv2.IMREAD_COLOR)
        if decoded is None:
            raise ValueError(f"a compressed image of format {message.format!r} cannot be decoded")
        return _grey(decoded, "bgr")
    encoding = message.encoding
    size = BYTES.get(encoding)
    if size is None:
        raise ValueError(f"the encoding {encoding!r} is not supported")
    width = message.width * size
    data = np.frombuffer(message.data, dtype=np.uint8)
    if width == 0 or message.step < width or len(data) != message.step * message.height:
        raise ValueError(f"{len(data)} bytes are no image of {message.width} x {message.height} px, {encoding}")
    rows = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :width])
    if encoding in BAYERS:
        return _grey(cv2.cvtColor(rows, BAYERS[encoding]), "rgb")
    if size > 2:
        return _grey(rows.reshape(message.height, message.width, size), encoding)
    return rows[:, size - 1 - message.is_bigendian :: size] if size == 2 else rows


def _grey(image: Array, channels: str) -> NDArray[np.uint8]:
    weights = np.zeros((1, image.shape[2]), dtype=np.float32)
    weights[0, [channels.index(name) for name in "rgb"]] = REC_709
    return np.asarray(cv2.transform(image, weights), dtype=np.uint8)


def pinhole_of(info: CameraInfo, rectified: bool) -> tuple[Array, Callable[[Array], Array]]:
    """Return a camera's matrix (3, 3), and what moves pixels (K, 2) of its images to those of that pinhole.

    Both are in pixels of wheretolook. With `rectified`, images are those of image_proc. Raises ValueError for a camera
    that is not calibrated, or of another model.
    """
    matrix = np.array(info.p).reshape(3, 4)[:, :3] if rectified else np.array(info.k).reshape(3, 3)
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise ValueError("the camera is not calibrated: the focal length in its CameraInfo is 0")
    if info.binning_x > 1 or info.binning_y > 1 or info.roi.width % info.width or info.roi.height % info.height:
        raise ValueError("binning and regions of interest in a CameraInfo are not supported")
    moved = matrix.copy()
    moved[:2, 2] += 0.5
    distortion = np.array(info.d)
    if rectified or not distortion.any():
        return moved, lambda pixels: pixels
    undistort = UNDISTORT.get(info.distortion_model)
    if undistort is None:
        raise ValueError(f"the distortion model {info.distortion_model!r} is not supported")

    def to_pinhole(pixels: Array) -> Array:
        at = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2) - 0.5
        return np.asarray(undistort(at, matrix, distortion, P=matrix)).reshape(-1, 2) + 0.5 if len(at) else pixels

    return moved, to_pinhole


def pose_matrix(pose: Pose) -> Array:
    """Convert a pose to (3, 4). Raises ValueError for a quaternion of length 0 or a number that is not finite."""
    return pose_of_numbers(pose_numbers(pose))


def pose_numbers(pose: Pose) -> Array:
    """Convert a pose to x, y, z and a unit quaternion qx, qy, qz, qw, which is not finite if it had length 0."""
    p = pose.position
    q = np.array([pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w])
    return np.array([p.x, p.y, p.z, *q / np.linalg.norm(q)])


def pose_of_numbers(numbers: Array) -> Array:
    """Convert x, y, z, qx, qy, qz, qw to (3, 4); raises as `pose_matrix`."""
    if not np.isfinite(numbers).all():
        raise ValueError(f"a pose is not finite, or its quaternion is 0: {numbers.tolist()}")
    return np.column_stack([Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]])


def pose_message(pose: Array) -> Pose:
    """Convert a pose (3, 4) to a message."""
    x, y, z = pose[:, 3].tolist()
    qx, qy, qz, qw = Rotation.from_matrix(pose[:, :3]).as_quat().tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def direction_message(direction: Array, frame: str, stamp: Time) -> Vector3Stamped:
    """Convert a direction (3,) of a frame to a message."""
    x, y, z = direction.tolist()
    message = Vector3Stamped(vector=Vector3(x=x, y=y, z=z))
    message.header.frame_id = frame
    message.header.stamp = stamp
    return message


def compose(a: Array, b: Array) -> Array:
    """Compose poses (3, 4)."""
    return np.column_stack([a[:, :3] @ b[:, :3], a[:, :3] @ b[:, 3] + a[:, 3]])


def inverse(pose: Array) -> Array:
    """Invert a pose (3, 4)."""
    return np.column_stack([pose[:, :3].T, -pose[:, :3].T @ pose[:, 3]])


def moved_covariance(covariance: Array, lever: Array) -> Array:
    """Move a covariance (6, 6) of position and rotation to a point of the same rigid body, `lever` (3,) away."""
    jacobian = np.eye(6)
    jacobian[:3, 3:] = np.cross(np.eye(3), lever).T
    return np.asarray(jacobian @ covariance @ jacobian.T)
