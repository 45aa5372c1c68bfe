"""Cameras: the ideal pinhole, and every model COLMAP knows, with its distortion, projected by COLMAP itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError, MapError

if TYPE_CHECKING:
    import pycolmap

MAX_RAY_ERROR = 1e-4  # largest distance between a point's direction and its pixel's ray (chord, about radians)


@dataclass(frozen=True)
class PinholeCamera:
    """Ideal pinhole camera.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        focal_px: focal length in pixels, the same in x and y. The default, 320 px at 640 x 480, is the paper's camera
            (90 degrees across).
    """

    width: int = 640
    height: int = 480
    focal_px: float = 320.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or not self.focal_px > 0:
            value = (self.width, self.height, self.focal_px)
            raise ConfigError("camera needs a positive width, height and focal_px", value=value)

    @property
    def cx(self) -> float:
        """Principal point x in pixels: the image centre."""
        return self.width / 2

    @property
    def cy(self) -> float:
        """Principal point y in pixels: the image centre."""
        return self.height / 2

    @property
    def matrix(self) -> Float:
        """Intrinsic matrix K, (3, 3)."""
        return np.array([[self.focal_px, 0, self.cx], [0, self.focal_px, self.cy], [0, 0, 1]])

    def project(self, points_cam: ArrayLike) -> Float:
        """Pixels (..., 2) of points (..., 3) in the camera frame. Points behind the camera project too, so test z."""
        points = np.asarray(points_cam, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            return points[..., :2] / points[..., 2:] * self.focal_px + (self.cx, self.cy)

    def in_image(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) lie in the image: 0 <= x < width and 0 <= y < height. NaN is outside."""
        return in_image(pixels, self.width, self.height)


def in_image(pixels: ArrayLike, width: int, height: int) -> NDArray[np.bool_]:
    """Whether pixels (..., 2) lie in an image: 0 <= x < width and 0 <= y < height. NaN is outside."""
    x, y = np.moveaxis(np.asarray(pixels), -1, 0)
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of any COLMAP model.

    Beyond the field of view that they were fitted to, distortion polynomials turn back and map points far outside of it
    into the image. So a point counts as seen only if the ray of its pixel, by COLMAP's own inverse, leads back to it.
    COLMAP's fisheye models see nothing at 90 degrees from the axis and beyond. Raises ConfigError if COLMAP has no such
    model, or the model takes other parameters.
    """

    model: str  # COLMAP's name, such as "OPENCV" or "OPENCV_FISHEYE"
    width: int  # of the image, in pixels
    height: int
    params: tuple[float, ...]  # intrinsics in COLMAP's order for the model

    def __post_init__(self) -> None:
        import pycolmap

        names = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
        if self.model not in names:
            fix = f"Use one of {', '.join(names)}."
            raise ConfigError("COLMAP has no such camera model", value=self.model, fix=fix)
        expected = pycolmap.Camera.create_from_model_name(1, self.model, 1.0, 1, 1).params_info
        if len(self.params) != len(expected.split(",")) or self.width < 1 or self.height < 1:
            problem = f"camera model {self.model} needs a positive size and the parameters {expected}"
            raise ConfigError(problem, value=(self.width, self.height, *self.params))
        has_focal_length = len(self._camera.focal_length_idxs()) > 0
        if not np.isfinite(self.params).all() or (has_focal_length and not self._camera.mean_focal_length() > 0):
            raise ConfigError("a camera needs finite parameters and a positive focal length", value=self.params)

    @classmethod
    def of(cls, camera: pycolmap.Camera) -> ColmapCamera:
        """From a camera of pycolmap."""
        return cls(camera.model_name, camera.width, camera.height, tuple(float(value) for value in camera.params))

    @classmethod
    def of_map(cls, model: str | Path) -> ColmapCamera:
        """The camera that made the COLMAP model in a folder; MapError if that cannot be read or has several or none."""
        import pycolmap

        path = Path(model)
        try:
            cameras = pycolmap.Reconstruction(path).cameras
        except Exception as error:
            raise MapError(f"cannot read the cameras: {error}", path=path, fix="Give a COLMAP model folder.") from error
        if len(cameras) != 1:
            fix = "Choose one: ColmapCamera.of(reconstruction.cameras[camera_id])."
            raise MapError("the map has not one camera but several", path=path, value=len(cameras), fix=fix)
        return cls.of(next(iter(cameras.values())))

    @cached_property
    def _camera(self) -> pycolmap.Camera:
        import pycolmap

        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    @property
    def matrix(self) -> Float:
        """Intrinsic matrix K, (3, 3). Raises ConfigError if the model has distortion."""
        if self.model not in ("SIMPLE_PINHOLE", "PINHOLE"):
            fix = "Undistort the images, for instance with COLMAP's image_undistorter."
            raise ConfigError("a camera with distortion has no intrinsic matrix", value=self.model, fix=fix)
        return np.asarray(self._camera.calibration_matrix())

    def project(self, points_cam: ArrayLike) -> Float:
        """Pixel coordinates (..., 2) of points (..., 3) in the camera frame.

        NaN where the model does not project the point, or projects it to a pixel that shows something else.
        """
        points = np.asarray(points_cam, dtype=np.float64)
        flat = points.reshape(-1, 3)
        with np.errstate(all="ignore"):
            pixels = np.asarray(self._camera.img_from_cam(flat))
            rows = np.flatnonzero(self.in_image(pixels))
            length = np.linalg.norm(flat[rows], axis=1, keepdims=True)
            miss = np.linalg.norm(flat[rows] / length - self.unproject(pixels[rows]), axis=1)
        pixels[rows[~(miss <= MAX_RAY_ERROR)]] = np.nan
        return pixels.reshape(*points.shape[:-1], 2)

    def unproject(self, pixels: ArrayLike) -> Float:
        """Unit rays (..., 3) of pixels (..., 2) in the camera frame; NaN where the model has none."""
        at = np.asarray(pixels, dtype=np.float64)
        rays = np.asarray(self._camera.cam_ray_from_img(at.reshape(-1, 2)))
        with np.errstate(invalid="ignore"):
            rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return rays.reshape(*at.shape[:-1], 3)

    def in_image(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) lie in the image: 0 <= x < width and 0 <= y < height. NaN is outside."""
        return in_image(pixels, self.width, self.height)

    def sees(self, points_cam: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (..., 3) of the camera frame fall into the image."""
        return self.in_image(self.project(points_cam))


Camera = PinholeCamera | ColmapCamera  # what visibility can be computed for
