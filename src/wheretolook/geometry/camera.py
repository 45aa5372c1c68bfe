"""Cameras: the ideal pinhole, and every model COLMAP knows, with its distortion, projected by COLMAP itself."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float, angle_deg, unit
from wheretolook.utils.errors import ConfigError, MapError, TableError, check_choice
from wheretolook.utils.files import read_text, write_text

MAX_SIDE_PX = 10**6  # of an image; COLMAP's limit is not much higher
EQUIRECTANGULAR = "EQUIRECTANGULAR"  # COLMAP's model of panoramas
MAX_PX = 1e12  # of a focal length or a principal point, so that products stay finite and huge integers are refused


class _Image:
    """The image of a camera."""

    width: int
    height: int

    def in_image(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) are in the image: 0 <= x < width and 0 <= y < height. NaN is outside."""
        x, y = np.moveaxis(np.asarray(pixels), -1, 0)
        return (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)


@dataclass(frozen=True)
class PinholeCamera(_Image):
    """Ideal pinhole camera.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        focal_px: focal length in pixels. The default, 320 px at 640 x 480, is the paper's camera (90 degrees across).
        focal_y_px: focal length down the image in pixels; None for the same as across.
        center_px: principal point (x, y) in pixels; None for the image's centre.

    Raises:
        ConfigError: a size or focal length that no camera has, such as a focal length in metres.
    """

    width: int = 640
    height: int = 480
    focal_px: float = 320.0
    focal_y_px: float | None = None
    center_px: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.focal_y_px == self.focal_px:  # one form, so that equal cameras are equal
            object.__setattr__(self, "focal_y_px", None)
        if self.center_px is not None and tuple(self.center_px) == (self.width / 2, self.height / 2):
            object.__setattr__(self, "center_px", None)
        _check_intrinsics(self.width, self.height, (self.fx, self.fy))
        if not all(abs(value) <= MAX_PX for value in (self.cx, self.cy)):
            raise ConfigError("a camera's principal point must be finite", value=self.center_px)

    @classmethod
    def of_field_of_view(cls, across_deg: float, width: int, height: int) -> PinholeCamera:
        """With square pixels, from the angle between the image's left and right side. Raises ConfigError."""
        if not 0 < across_deg < 180:
            fix = "Give the angle between the image's left and right side; a fisheye needs a COLMAP model."
            raise ConfigError("a pinhole's field of view must be between 0 and 180 degrees", value=across_deg, fix=fix)
        if across_deg <= np.pi:
            fix = f"If it is in radians, give {np.degrees(across_deg):.0f}; else give the focal length in pixels."
            raise ConfigError("a field of view is in degrees, and this is a telescope's", value=across_deg, fix=fix)
        return cls(width, height, width / 2 if across_deg == 90 else width / 2 / np.tan(np.radians(across_deg) / 2))

    @property
    def fx(self) -> float:
        """Focal length across the image in pixels."""
        return self.focal_px

    @property
    def fy(self) -> float:
        """Focal length down the image in pixels."""
        return self.focal_px if self.focal_y_px is None else self.focal_y_px

    @property
    def cx(self) -> float:
        """Principal point x in pixels."""
        return self.width / 2 if self.center_px is None else self.center_px[0]

    @property
    def cy(self) -> float:
        """Principal point y in pixels."""
        return self.height / 2 if self.center_px is None else self.center_px[1]

    @property
    def mean_focal_px(self) -> float:
        """Mean of both focal lengths in pixels."""
        return (self.fx + self.fy) / 2

    @property
    def principal_point(self) -> tuple[float, float]:
        """Principal point (x, y) in pixels."""
        return self.cx, self.cy

    @property
    def matrix(self) -> Float:
        """Intrinsic matrix K, (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @cached_property
    def colmap(self) -> ColmapCamera:
        """The same camera by a model of COLMAP: SIMPLE_PINHOLE if its pixels are square, else PINHOLE."""
        if self.fx == self.fy:
            return ColmapCamera("SIMPLE_PINHOLE", self.width, self.height, (self.fx, self.cx, self.cy))
        return ColmapCamera("PINHOLE", self.width, self.height, (self.fx, self.fy, self.cx, self.cy))

    def record(self) -> dict[str, Any]:
        """The camera as plain values for JSON files, see `camera_of_record`."""
        if self.focal_y_px is None and self.center_px is None:
            return {"width": self.width, "height": self.height, "focal_px": self.focal_px}
        return self.colmap.record()

    def project(self, points_cam: ArrayLike) -> Float:
        """Pixels (..., 2) of points (..., 3) in the camera frame. Points behind the camera project too, so test z."""
        points = np.asarray(points_cam, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            # by column: NumPy is slow along an axis of two
            x = points[..., 0] / points[..., 2] * self.fx + self.cx
            y = points[..., 1] / points[..., 2] * self.fy + self.cy
        return np.stack([x, y], axis=-1)

    def unproject(self, pixels: ArrayLike) -> Float:
        """Unit rays (..., 3) of pixels (..., 2) in the camera frame."""
        at = (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        rays = np.concatenate([at, np.ones_like(at[..., :1])], axis=-1)
        return unit(rays)


def _check_intrinsics(width: int, height: int, focal_px: tuple[float, ...]) -> None:
    """Raise ConfigError unless sizes are whole pixels, and focal lengths at least 1 % of the image's longer side.

    A pinhole of that focal length would see 179 degrees; a smaller number is a focal length in metres or millimetres.
    """
    if not all(isinstance(side, Integral) and 1 <= side <= MAX_SIDE_PX for side in (width, height)):
        raise ConfigError("an image's sides must be 1 to a million whole pixels", value=(width, height))
    if not all(max(width, height) / 100 <= focal <= MAX_PX for focal in focal_px):
        fix = f"Half the width ({width / 2:g}) divided by the tangent of half the angle across."
        raise ConfigError("a focal length must be in pixels, not metres or millimetres", value=focal_px, fix=fix)


@dataclass(frozen=True)
class ColmapCamera(_Image):
    """A camera of any COLMAP model.

    Beyond the field of view that they were fitted to, distortion polynomials are not monotonic and map points far outside of it
    into the image. So a point counts as visible only if the ray of its pixel, by COLMAP's own inverse, leads back to it.
    COLMAP's fisheye models see nothing at 90 degrees from the axis and beyond. Raises ConfigError if COLMAP has no such
    model, or the model takes other parameters.
    """

    model: str  # COLMAP's name, such as "OPENCV" or "OPENCV_FISHEYE"
    width: int  # of the image, in pixels
    height: int
    params: tuple[float, ...]  # intrinsics in COLMAP's order for the model

    def __post_init__(self) -> None:
        focal_lengths = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2}.get(self.model)
        if focal_lengths and len(self.params) == focal_lengths + 2 and np.isfinite(self.params).all():
            _check_intrinsics(self.width, self.height, self.params[:focal_lengths])
            return  # a robot has no COLMAP
        import pycolmap

        names = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
        check_choice("camera model", self.model, names)
        expected = pycolmap.Camera.create_from_model_name(1, self.model, 1.0, 1, 1)
        if len(self.params) != len(expected.params) or not np.isfinite(self.params).all():
            problem = f"camera model {self.model} needs the finite parameters {expected.params_info}"
            raise ConfigError(problem, value=self.params)
        focal_px = tuple(self.params[i] for i in expected.focal_length_idxs())  # panoramas have none
        _check_intrinsics(self.width, self.height, focal_px)

    @cached_property
    def _camera(self) -> Any:
        import pycolmap

        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    @property
    def mean_focal_px(self) -> float:
        """Mean focal length in pixels; of a panorama, pixels per radian across."""
        return mean_focal_px(self._camera)

    @property
    def principal_point(self) -> tuple[float, float]:
        """Principal point (x, y) in pixels; of a panorama the image's centre."""
        if len(self._camera.principal_point_idxs()) == 0:
            return self.width / 2, self.height / 2
        return float(self._camera.principal_point_x), float(self._camera.principal_point_y)

    @property
    def colmap(self) -> ColmapCamera:
        """The camera itself."""
        return self

    def record(self) -> dict[str, Any]:
        """The camera as plain values for JSON files, see `camera_of_record`."""
        return {"model": self.model, "width": self.width, "height": self.height, "params": list(self.params)}

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
            miss = np.linalg.norm(unit(flat[rows]) - self.unproject(pixels[rows]), axis=1)
        pixels[rows[~(miss <= 1e-4)]] = np.nan  # chord, about radians
        return pixels.reshape(*points.shape[:-1], 2)

    def unproject(self, pixels: ArrayLike) -> Float:
        """Unit rays (..., 3) of pixels (..., 2) in the camera frame; NaN where the model has none."""
        at = np.asarray(pixels, dtype=np.float64)
        rays = np.asarray(self._camera.cam_ray_from_img(at.reshape(-1, 2)))
        with np.errstate(invalid="ignore"):
            rays = unit(rays)
        return rays.reshape(*at.shape[:-1], 3)

    def sees(self, points_cam: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (..., 3) of the camera frame project into the image."""
        return self.in_image(self.project(points_cam))


Camera = PinholeCamera | ColmapCamera  # what views can be scored for


def camera_of(model: str, width: int, height: int, params: Iterable[float]) -> Camera:
    """The camera of a COLMAP model, for PINHOLE and SIMPLE_PINHOLE the faster ideal pinhole. Raises ConfigError."""
    camera = ColmapCamera(model, width, height, tuple(float(value) for value in params))
    if model == "PINHOLE":
        fx, fy, cx, cy = camera.params
        return PinholeCamera(width, height, fx, fy, (cx, cy))
    if model == "SIMPLE_PINHOLE":
        focal, cx, cy = camera.params
        return PinholeCamera(width, height, focal, center_px=(cx, cy))
    return camera


def scale_focal(camera: Camera, ratio: float) -> Camera:
    """The camera with its focal lengths multiplied by a ratio, and the same distortion; a panorama as it is."""
    if isinstance(camera, PinholeCamera):
        focal_y_px = None if camera.focal_y_px is None else camera.focal_y_px * ratio
        return replace(camera, focal_px=camera.focal_px * ratio, focal_y_px=focal_y_px)
    params = np.array(camera.params)
    params[list(camera._camera.focal_length_idxs())] *= ratio
    return replace(camera, params=tuple(params.tolist()))


def turn_camera(camera: Camera, quarters: int) -> Camera:
    """The camera of images turned to the left by quarters, as by `np.rot90`.

    Raises ConfigError for models whose images or distortion have no such turn.
    """
    for _ in range(quarters % 4):
        given = camera.colmap
        if given.model in (EQUIRECTANGULAR, "RAD_TAN_THIN_PRISM_FISHEYE"):
            raise ConfigError("a camera of this model is not turned with its images", value=given.model)
        names = given._camera.params_info.split(", ")
        old = dict(zip(names, given.params, strict=True))
        # the pixel (u, v) becomes (v, width - u), the direction (x, y) becomes (y, -x)
        new = {**old, "cx": old["cy"], "cy": given.width - old["cx"]}
        if "fy" in old:
            new |= {"fx": old["fy"], "fy": old["fx"]}
        if "p1" in old:
            new |= {"p1": -old["p2"], "p2": old["p1"]}
        if "sx1" in old:
            new |= {"sx1": old["sy1"], "sy1": -old["sx1"]}
        camera = camera_of(given.model, given.height, given.width, new.values())
    return camera


def mean_focal_px(camera: Any) -> float:
    """Mean focal length of a `pycolmap.Camera` in pixels; of a panorama, pixels per radian across."""
    if len(camera.focal_length_idxs()) == 0:
        return float(camera.width / (2 * np.pi))
    return float(camera.mean_focal_length())


def camera_of_record(record: Mapping[str, Any]) -> Camera:
    """The camera of a `record` read from a file. Raises ConfigError, TypeError or ValueError if it is none."""
    return camera_of(**record) if "model" in record else PinholeCamera(**record)


def parse_camera(text: str) -> Camera:
    """Parse "MODEL,width,height,parameters", with COLMAP's models and order of parameters, separated by commas or blanks.

    Raises ConfigError if the text describes no camera.
    """
    try:
        model, width, height, *params = text.replace(",", " ").split()
        return camera_of(model.upper(), int(width), int(height), map(float, params))
    except ValueError as error:
        fix = "Write MODEL,width,height,parameters as COLMAP orders them, such as PINHOLE,640,480,320,320,320,240."
        raise ConfigError("this is no camera", value=text, fix=fix) from error


def parse_size(text: str) -> tuple[int, int]:
    """Parse width and height in pixels, such as "640x480". Raises ConfigError if the text is no size."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ConfigError("this is no image size", value=text, fix="Write it in pixels, such as 640x480.")
    return int(width), int(height)


def read_named_cameras(path: Path) -> dict[str, Camera]:
    """Read cameras by the names of their images, a line each: name, model, size, parameters, as hloc lists queries.

    Raises TableError if the file cannot be read, a line describes no camera, or two lines of a name differ.
    """
    cameras: dict[str, Camera] = {}
    try:
        lines = read_text(path, 2**28).splitlines()
    except (OSError, ValueError) as error:
        raise TableError(f"the list of cameras cannot be read: {error}", path=path) from error
    for line in lines:
        if line.strip() and not line.startswith("#"):
            found = re.fullmatch(r"(\S.*?)\s+(\w+\s+\d+\s+\d+\s.*)", line.strip())
            try:
                if found is None:
                    raise ConfigError("a line is: name MODEL width height parameters")
                camera = parse_camera(found[2])
                if cameras.setdefault(found[1], camera) != camera:
                    raise ConfigError("another line has this name")
            except ConfigError as error:
                raise TableError(f"no camera in this line: {error}", path=path, value=line[:200]) from error
    return cameras


def read_cameras(path: Path) -> dict[int, Camera]:
    """Cameras by their camera_id from a file in COLMAP's text format, a line each: id, model, size, parameters.

    Raises:
        TableError: a line describes no camera.
    """
    cameras = read_named_cameras(path)
    try:
        return {int(name): camera for name, camera in cameras.items()}
    except ValueError as error:
        raise TableError("a camera_id is no number", path=path) from error


def write_cameras(cameras: Mapping[int, Camera], path: Path) -> None:
    """Write what `read_cameras` reads."""
    lines = ["# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, camera in cameras.items():
        model, width, height, params = camera.colmap.record().values()
        lines.append(" ".join(map(str, (number, model, width, height, *params))))
    write_text(path, "\n".join(lines) + "\n")


def cameras_by_id(cameras: Any, path: Path) -> dict[int, Camera]:
    """Cameras of the pycolmap model in a folder by their camera_id; MapError if one is no camera."""
    by_id: dict[int, Camera] = {}
    for number, camera in sorted(cameras.items()):
        try:
            by_id[number] = camera_of(camera.model_name, camera.width, camera.height, camera.params)
        except ConfigError as error:
            raise MapError(f"camera {number}: {error.problem}", path=path, value=error.value, fix=error.fix) from error
    return by_id


def only_camera(cameras: Mapping[int, Camera], path: Path) -> Camera:
    """The camera that mapped; MapError if there is none, or if there are several that differ."""
    different = list(dict.fromkeys(cameras.values()))
    if len(different) == 1:
        return different[0]
    listed = "; ".join(f"{number}: {describe_camera(camera)}" for number, camera in list(cameras.items())[:10])
    one = min(cameras)
    fix = f"Name one of them (--camera-id {one}, in Python camera={one}), or describe another by --camera."
    raise MapError(f"the map has {len(different)} cameras, not one ({listed})", path=path, fix=fix)


def describe_camera(camera: Camera) -> str:
    """Size, and field of view or model of a camera, in words."""
    size = f"{camera.width} x {camera.height} px"
    if isinstance(camera, ColmapCamera):
        return f"{size}, {camera.model}"
    across, down = field_of_view_deg(camera)
    return f"{size}, {across:.1f} x {down:.1f} degrees"


def field_of_view_deg(camera: Camera) -> tuple[float, float]:
    """Angles between the rays through the middles of the image's left and right, and of its upper and lower side."""
    w = camera.width
    h = camera.height
    ends = np.array([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])
    middle = camera.unproject([w / 2, h / 2])
    angles = angle_deg(camera.unproject(ends) @ middle)
    return float(angles[0] + angles[1]), float(angles[2] + angles[3])


def draw_camera(rng: np.random.Generator, any_lens: bool = False) -> PinholeCamera:
    """Draw a common pinhole: 40 to 120 degrees along the longer side, 320 to 1,280 px wide or high.

    With `any_lens`, 25 to 120 degrees and 320 to 2,000 px. Sides are 4:3, 3:2, 16:9 or 1:1, also upright; the principal
    point is off the centre by up to 5 % of a side.
    """
    longer = np.exp(rng.uniform(*np.log((320, 2000 if any_lens else 1280))))
    proportions = ((4, 3), (3, 2), (16, 9), (1, 1), (3, 4), (2, 3), (9, 16))
    a, b = proportions[rng.integers(len(proportions))]
    width, height = (2 * round(longer * side / max(a, b) / 2) for side in (a, b))
    across = rng.uniform(25.0 if any_lens else 40.0, 120.0)
    focal_px = round(max(width, height) / 2 / np.tan(np.radians(across) / 2), 2)
    x, y = 0.5 + rng.uniform(-0.05, 0.05, 2)
    center = (round(width * x, 2), round(height * y, 2))
    return PinholeCamera(width, height, focal_px, center_px=center)


@dataclass(frozen=True)
class CameraConfig:
    """A camera by its options: a pinhole of a focal length or field of view, or any model of COLMAP.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        focal_px: focal length of a pinhole in pixels; by default half the width, 90 degrees across.
        fov_deg: instead, the angle between the image's left and right side, below 180 degrees.
        model: name of a COLMAP model, such as OPENCV or OPENCV_FISHEYE, instead of a centred pinhole.
        params: intrinsics in COLMAP's order for that model.

    Raises:
        ConfigError: there is no such camera.
    """

    width: int = 640
    height: int = 480
    focal_px: float | None = None
    fov_deg: float | None = None
    model: str = ""
    params: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        n_descriptions = (self.focal_px is not None) + (self.fov_deg is not None) + bool(self.model)
        if n_descriptions > 1 or (self.params and not self.model):
            raise ConfigError("a camera is described by focal_px, or fov_deg, or model and params", value=self)
        if not self.model:  # COLMAP's models are looked up when they are used: that takes a second
            _ = self.camera

    @cached_property
    def camera(self) -> Camera:
        """The camera."""
        if self.model:
            return camera_of(self.model, self.width, self.height, self.params)
        if self.focal_px is not None:
            return PinholeCamera(self.width, self.height, self.focal_px)
        return PinholeCamera.of_field_of_view(90.0 if self.fov_deg is None else self.fov_deg, self.width, self.height)

    @classmethod
    def of(cls, camera: Camera) -> CameraConfig:
        """The options of a camera."""
        record = camera.record()
        return cls(**{**record, "params": tuple(record["params"])} if "params" in record else record)
