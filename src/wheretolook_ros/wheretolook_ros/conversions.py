"""Converts ROS messages to arrays and back.

Poses are matrices (3, 4). ROS puts pixel (0, 0) at the centre of the top-left pixel, wheretolook (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import yaml
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, Vector3, Vector3Stamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from PIL import UnidentifiedImageError
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

Array = NDArray[Any]

REC_709 = {"r": 0.2126, "g": 0.7152, "b": 0.0722}  # as in the maps
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

COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
COMPRESSED = "JPEG", "PNG", "TIFF"  # formats of image_transport


def seconds(stamp: Time) -> float:
    """Convert a stamp to seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def finite(values: Array) -> Array:
    """Return values; raises ValueError if one is not finite."""
    if not np.isfinite(values).all():
        raise ValueError("a number is not finite")
    return values


def grey_image(message: Image | CompressedImage, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Convert an image of a size (width, height) to grey (H, W) uint8.

    Raises ValueError for another size, which is read before the image is decoded, or for an encoding that is not known.
    """
    if isinstance(message, CompressedImage):
        try:
            with PIL.Image.open(BytesIO(message.data), formats=COMPRESSED) as image:
                check_size(image.size, size)
        except UnidentifiedImageError as error:
            raise ValueError(f"cannot decode the compressed image of format {message.format!r}") from error
        decoded = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        if decoded is None:
            raise ValueError(f"cannot decode the compressed image of format {message.format!r}")
        return _grey(_bytes(decoded), "bgr")
    encoding = message.encoding
    if encoding not in BYTES:
        raise ValueError(f"image encoding {encoding!r} is not supported, only {', '.join(BYTES)}")
    check_size((message.width, message.height), size)
    n_bytes = BYTES[encoding]
    width = message.width * n_bytes
    data = np.frombuffer(message.data, np.uint8)
    if not 0 < width <= message.step or len(data) != message.step * message.height:
        size_px = f"{message.width} x {message.height} px {encoding}, step {message.step}"
        raise ValueError(f"{len(data)} bytes of data do not fit an image of {size_px}")
    rows = np.ascontiguousarray(data.reshape(message.height, message.step)[:, :width])
    if encoding in BAYERS:
        return _grey(cv2.cvtColor(rows, BAYERS[encoding]), "rgb")
    if n_bytes > 2:
        return _grey(rows.reshape(message.height, message.width, n_bytes), encoding)
    if n_bytes == 1:
        return rows
    return _bytes(rows.view(">u2" if message.is_bigendian else "<u2"))


def check_size(found: tuple[int, int], expected: tuple[int, int]) -> None:
    """Raise ValueError if an image has another size than its camera_info."""
    if found != expected:
        raise ValueError("the image has {} x {} px, but camera_info says {} x {}".format(*found, *expected))


def _bytes(values: Array) -> NDArray[np.uint8]:
    """Scale values of 8 to 16 bits, a number that no message states, by the brightest one."""
    return (values >> max(int(values.max(initial=0)).bit_length() - 8, 0)).astype(np.uint8)


def _grey(image: Array, channels: str) -> NDArray[np.uint8]:
    weights = [REC_709.get(name, 0.0) for name in channels[: image.shape[2]]]
    return cv2.transform(image, np.array([weights])).astype(np.uint8)


def pinhole_of(info: CameraInfo, rectified: bool) -> tuple[tuple[Any, ...], Callable[[Array], Array]]:
    """Return fx, fy and (cx, cy) of a camera, and what moves pixels (K, 2) of its images to those of that pinhole.

    Both are in pixels of wheretolook. With `rectified`, images are those of image_proc. Raises ValueError for a camera
    that is not calibrated, or of another model.
    """
    for name, numbers in (("k", info.k), ("p", info.p), ("d", info.d)):
        if not np.isfinite(numbers).all():
            raise ValueError(f"camera_info's {name} has a number that is not finite")
    matrix = np.reshape(info.p, (3, 4))[:, :3] if rectified else np.reshape(info.k, (3, 3))
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    if not min(fx, fy) > 0:
        raise ValueError("the camera is not calibrated: no positive focal length in camera_info")
    if info.binning_x > 1 or info.binning_y > 1 or info.roi.width % info.width or info.roi.height % info.height:
        raise ValueError("camera_info has binning or a region of interest, which is not supported")
    pinhole = fx, fy, (cx + 0.5, cy + 0.5)
    distortion = np.array(info.d)
    if rectified or not distortion.any():
        return pinhole, lambda pixels: pixels
    if info.distortion_model not in UNDISTORT:
        raise ValueError(f"distortion model {info.distortion_model!r} is not supported, only {', '.join(UNDISTORT)}")
    if len(distortion) not in COEFFICIENTS[info.distortion_model]:
        raise ValueError(
            f"distortion model {info.distortion_model!r} has another number of coefficients than {len(distortion)}"
        )
    undistort = UNDISTORT[info.distortion_model]

    def to_pinhole(pixels: Array) -> Array:
        moved = undistort(pixels[:, None] - 0.5, matrix, distortion, P=matrix) if len(pixels) else pixels
        return np.reshape(moved, (-1, 2)) + 0.5

    return pinhole, to_pinhole


def pose_matrix(pose: Pose) -> Array:
    """Convert a pose to (3, 4). Raises ValueError for a quaternion of length 0 or a number that is not finite."""
    p = pose.position
    q = pose.orientation
    return finite(np.column_stack([Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [p.x, p.y, p.z]]))


def pose_message(pose: Array) -> Pose:
    """Convert a pose (3, 4) to a message."""
    turned = _named(Quaternion, Rotation.from_matrix(pose[:, :3]).as_quat())
    return Pose(position=_named(Point, pose[:, 3]), orientation=turned)


def transform_message(pose: Array) -> Transform:
    """Convert a pose (3, 4) to a transform."""
    return Transform(translation=_named(Vector3, pose[:, 3]), rotation=pose_message(pose).orientation)


def localizability_message(folder: Path, frame: str) -> OccupancyGrid:
    """Read a mask of `wheretolook select --nav2` as the percentage of views that localize; -1 where there is no view."""
    about = yaml.safe_load((folder / "mask.yaml").read_text(encoding="utf-8"))
    with PIL.Image.open(folder / about["image"]) as image:
        pixels = np.asarray(image)[::-1]
    grid = OccupancyGrid(header=Header(frame_id=frame))
    grid.info.height, grid.info.width = pixels.shape
    grid.info.resolution = about["resolution"]
    x, y, _ = about["origin"]
    grid.info.origin.position = Point(x=x, y=y)
    grid.data = np.where(pixels == 255, -1, np.rint(pixels / 2.55)).astype(int).ravel().tolist()
    return grid


def direction_message(direction: Array, frame: str, stamp: Time) -> Vector3Stamped:
    """Convert a direction (3,) of a frame to a message."""
    return Vector3Stamped(header=Header(frame_id=frame, stamp=stamp), vector=_named(Vector3, direction))


def _named(kind: Any, values: Array) -> Any:
    return kind(**dict(zip("xyzw", values.tolist(), strict=False)))


def moved_covariance(covariance: Array, lever: Array) -> Array:
    """Move a covariance (6, 6) of position and rotation to a point of the same rigid body, `lever` (3,) away."""
    jacobian = np.eye(6)
    jacobian[:3, 3:] = np.cross(np.eye(3), lever).T
    return jacobian @ covariance @ jacobian.T
