"""Images to localize, and their localized poses as tables and files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from wheretolook.dataset.config import CONTRADICTED, LOCALIZED, NO_POSE
from wheretolook.geometry.camera import Camera, PinholeCamera, camera_of, describe_camera
from wheretolook.geometry.pose_files import images_text
from wheretolook.geometry.poses import Float, camera_centers, pan_tilt_angles, quaternion_from_rotation
from wheretolook.localization.rig_localization import JointLocalization
from wheretolook.mapping.colmap_model import find_camera
from wheretolook.mapping.map import Map
from wheretolook.mapping.map_frame import IDENTITY, MapFrame
from wheretolook.mapping.photographs import read_photograph, reduce_photograph
from wheretolook.utils.errors import ConfigError, PoseError
from wheretolook.utils.files import path_ends, write_json, write_text
from wheretolook.utils.texts import quiet_colmap

if TYPE_CHECKING:
    from matplotlib.figure import Figure


MAX_FOCAL_RATIO = 1.05  # of focal lengths that count as equal; those in EXIF data are rounded


@dataclass(frozen=True, eq=False)
class QueryImage:
    """An image to localize, as its keypoints are extracted, and its camera."""

    name: str
    rgb: NDArray[np.uint8]  # (H, W, 3)
    camera: Camera  # of that size


class QueryImages:
    """Reads images to localize in a map, opened from a COLMAP model.

    The camera of an image is the given one. Otherwise it is the model's: that of the mapping image of the same name, or
    of those of the same proportions if their focal lengths agree; unless the EXIF focal length contradicts it.
    Otherwise it is a pinhole of the EXIF focal length.
    """

    def __init__(self, opened: Map) -> None:
        assert opened.path is not None and opened.images is not None
        self.folder = opened.path
        self.cameras = opened.cameras
        ids = opened.images.image_cameras.tolist()
        self.by_name = {name: self.cameras[i] for name, i in zip(opened.images.image_names, ids, strict=True)}

    def known_camera(self, camera: Camera | int | None) -> Camera | None:
        """Return a camera, given as one or by its camera_id. Raises MapError if the model has no such camera."""
        if camera is not None and not isinstance(camera, (int, Camera)):
            raise ConfigError("this is no camera", value=camera, fix="Give a Camera, or a camera_id of the model.")
        return None if camera is None else find_camera(self.cameras, self.folder, camera)

    def read(self, image: str | Path | NDArray[np.uint8], name: str, camera: Camera | None = None) -> QueryImage:
        """Read a file, or take an array (H, W, 3) uint8 RGB, of a given or known camera.

        Raises MapError if the file cannot be read, PoseError for an array that is no image, ConfigError if the camera
        is unknown or has other proportions.
        """
        if isinstance(image, np.ndarray):
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
                raise PoseError("an image is an array (H, W, 3) uint8", value=(image.shape, str(image.dtype)))
            return _fitted(name, image, self._camera(None, image, camera))
        path = Path(image)
        rgb = read_photograph(path)
        expected = camera or self._named(path)
        if expected is not None and not _has_proportions(expected, rgb):
            stored = read_photograph(path, turned=False)  # as some versions of COLMAP read photographs
            rgb = stored if _has_proportions(expected, stored) else rgb
        return _fitted(name, rgb, self._camera(path, rgb, camera))

    def _named(self, path: Path) -> Camera | None:
        """Return the camera of the mapping image of the same name: of the longest end of the path, at least the file name."""
        return next((self.by_name[end] for end in path_ends(path.absolute()) if end in self.by_name), None)

    def _camera(self, path: Path | None, rgb: NDArray[np.uint8], given: Camera | None) -> Camera:
        height, width = rgb.shape[:2]
        size = f"{width} x {height} px"
        if given is not None:
            if not _has_proportions(given, rgb):
                problem = f"the image of {size} has other proportions than the camera"
                raise ConfigError(problem, path=path, value=describe_camera(given), fix="Correct --camera.")
            return given
        named = None if path is None else self._named(path)
        alike = [camera for camera in self.cameras.values() if _has_proportions(camera, rgb)]
        if named is not None and named in alike:
            alike = [named]
        focal = np.array([camera.colmap.mean_focal_px / camera.width for camera in alike])
        in_exif = None if path is None else _exif_focal_px(path)
        if len(alike) and focal.max() <= MAX_FOCAL_RATIO * focal.min():
            camera = alike[int(np.argsort(focal)[len(focal) // 2])]
            ratio = 1.0 if in_exif is None else in_exif / width / focal.min()
            if 1 / MAX_FOCAL_RATIO**2 <= ratio <= MAX_FOCAL_RATIO**2:
                return camera
        if in_exif is not None:
            return PinholeCamera(width, height, in_exif)
        problem = f"the camera of this image of {size} is unknown: it has no EXIF focal length"
        problem += f", and the map has {len(alike)} cameras of its proportions that differ" if alike else ""
        raise ConfigError(problem, path=path, fix="Give --camera MODEL,width,height,parameters, in Python camera.")


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of files, or where some are equal, the paths from the folder that has all."""
    names = [path.name for path in paths]
    if len({*names}) == len(names):
        return names
    folder = os.path.commonpath([path.absolute().parent for path in paths])
    return [os.path.relpath(path, folder) for path in paths]


def _has_proportions(camera: Camera, rgb: NDArray[np.uint8]) -> bool:
    height, width = rgb.shape[:2]
    ratio = width * camera.height / (height * camera.width)
    return 1 / 1.01 <= ratio <= 1.01


def _fitted(name: str, rgb: NDArray[np.uint8], camera: Camera) -> QueryImage:
    """Reduce an image to the size of its camera and to 1,600 px, and return it with the camera of that size."""
    reduced = reduce_photograph(rgb, min(1600, max(camera.width, camera.height)))
    height, width = reduced.shape[:2]
    if (width, height) != (camera.width, camera.height):
        scaled = pycolmap.Camera(**camera.colmap.record())
        scaled.rescale(width, height)
        camera = camera_of(scaled.model_name, width, height, scaled.params)
    return QueryImage(name, reduced, camera)


def _exif_focal_px(path: Path) -> float | None:
    """Read the focal length of a photograph in pixels from its EXIF data; None without."""
    options = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE")
    try:
        with quiet_colmap():
            camera = pycolmap.infer_camera_from_image(path, options)
    except (ValueError, RuntimeError):  # a format that COLMAP does not read
        return None
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else None


FAILED = "error"  # status of an image that cannot be read, or whose camera is unknown


@dataclass(frozen=True, eq=False)
class Localized:
    """The pose of one image, or of N images of a rig, in the map's own frame and unit, and the rival poses.

    Attributes:
        names: N names of the images.
        status: "localized"; "contradicted", if the images contradict the given rotations, which are then refined with the
            pose; "too_few_matches" or "no_pose"; "error" in a batch, for an image that cannot be used.
        reason: why it is not localized.
        cam_from_world: (N, 3, 4), world-to-camera; camera x right, y down, z forward. None unless localized or
            contradicted.
        probability: that the pose is right (`wheretolook.localization.confidence`).
        n_matches: matches of all images with the map.
        n_inliers: of these, or of those found again under the pose, the ones that agree with it.
        deviation: one standard deviation of the position, in the map's unit, and of the orientation in degrees.
        rivals: other poses that matches support, the most probable first, without rivals of their own.
        frame: the map's own frame.
        cameras: of the images, as keypoints were extracted.
        images: the images themselves.
        joint: the result in the world: metres, z up.
    """

    names: tuple[str, ...]
    status: str
    reason: str = ""
    cam_from_world: Float | None = None
    probability: float = 0.0
    n_matches: int = 0
    n_inliers: int = 0
    deviation: tuple[float, float] = (np.inf, np.inf)
    rivals: tuple[Localized, ...] = ()
    frame: MapFrame = field(default=IDENTITY, repr=False)
    cameras: tuple[Camera, ...] = field(default=(), repr=False)
    images: tuple[QueryImage, ...] = field(default=(), repr=False)
    joint: JointLocalization | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls, images: Sequence[QueryImage], joint: JointLocalization, probabilities: Float, frame: MapFrame
    ) -> Localized:
        """Convert a joint localization and the probabilities (1 + rivals,) of its poses to the map's own frame."""
        names = tuple(image.name for image in images)
        unit = frame.world_from_map.scale
        values: dict[str, Any] = {"names": names, "frame": frame, "images": tuple(images), "joint": joint}
        values["cameras"] = tuple(image.camera for image in images)
        values |= {"n_matches": joint.n_matches, "n_inliers": joint.n_inliers}
        contradiction = ""
        if joint.turn_error_deg:
            contradiction = f"the images contradict the given rotations, by up to {joint.turn_error_deg:.1f} degrees"
        if joint.status not in (LOCALIZED, CONTRADICTED):
            found = f"{joint.n_inliers} of {joint.n_matches} matches agree with the best pose"
            reason = found if joint.status == NO_POSE else f"{joint.n_matches} matches with the map"
            return cls(status=joint.status, reason="; ".join(filter(None, (reason, contradiction))), **values)
        assert joint.cams_from_world is not None
        rivals = [
            cls.of(images, rival, p, frame) for rival, p in zip(joint.rivals, probabilities[1:, None], strict=True)
        ]
        rivals = [rival for rival in rivals if rival.status == LOCALIZED]
        return cls(
            status=joint.status,
            reason=contradiction,
            cam_from_world=frame.world_from_map.inverse.apply_to_poses(joint.cams_from_world),
            probability=float(probabilities[0]),
            deviation=(joint.deviation[0] / unit, joint.deviation[1]),
            rivals=tuple(sorted(rivals, key=lambda rival: -rival.probability)),
            **values,
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def positions(self) -> Float:
        """Camera centres in the map (N, 3); NaN without a pose."""
        return np.full((len(self), 3), np.nan) if self.cam_from_world is None else camera_centers(self.cam_from_world)

    def describe(self) -> str:
        """State the pose and its probability, or why there is none, in one line."""
        if self.cam_from_world is None:
            return f"not localized: {self.reason}"
        at = ", ".join(f"{value:.3f}" for value in self.positions[0])
        matches = f"{self.n_inliers} inliers, {self.n_matches} matches"
        rivals = "" if not self.rivals else f" (of rivals at most {self.rivals[0].probability:.3f})"
        doubt = self.reason and f"; {self.reason}"
        return f"({at}), probability {self.probability:.3f}{rivals}; {matches}{doubt}"

    def without_images(self) -> Localized:
        """Return the result without the images and `joint`, which take megabytes."""
        rivals = tuple(rival.without_images() for rival in self.rivals)
        return replace(self, images=(), joint=None, rivals=rivals)

    def save(self, path: str | Path) -> None:
        """Write a CSV, a JSON file, or COLMAP's images.txt, by the name of the file. Raises ConfigError for others."""
        save_localized([self], Path(path))

    def table(self) -> pd.DataFrame:
        """Return a row for each image; NaN where there is no pose."""
        columns = (*"xyz", "yaw_deg", "pitch_deg", "qw", "qx", "qy", "qz", "deviation", "deviation_deg")
        values = np.full((len(self), len(columns)), np.nan)
        if self.cam_from_world is not None:
            quaternions = quaternion_from_rotation(np.swapaxes(self.cam_from_world[:, :, :3], 1, 2))
            angles = np.degrees(pan_tilt_angles(self.cam_from_world[:, 2, :3] @ self.frame.world_from_map.rotation.T))
            deviation = np.tile(self.deviation, (len(self), 1))
            values = np.column_stack([self.positions, *angles, quaternions, deviation])
        rival = self.rivals[0].probability if self.rivals else np.nan
        return pd.DataFrame(
            {
                "image": self.names,
                "status": self.status,
                "probability": self.probability,
                **dict(zip(columns, values.T, strict=True)),
                "n_matches": self.n_matches,
                "n_inliers": self.n_inliers,
                "n_rivals": len(self.rivals),
                "rival_probability": rival,
                "reason": self.reason,
                **self.frame.angle_columns,
            }
        )


def check_localized_format(path: Path) -> str:
    """Return the format that a file's name stands for, "csv", "json" or "txt". Raises ConfigError for another name."""
    suffix = path.suffix[1:].lower()
    if suffix not in ("csv", "json") and path.name != "images.txt":
        fix = "Name it .csv, .json or images.txt."
        raise ConfigError("poses of images cannot be written in this format", path=path, fix=fix)
    return suffix


def save_localized(results: Sequence[Localized], path: Path) -> None:
    """Write results to a file of the format of its name, atomically; images.txt has the localized ones only."""
    suffix = check_localized_format(path)
    if suffix == "csv":
        table = pd.concat([result.table() for result in results])
        write_text(path, table.to_csv(index=False, lineterminator="\n", float_format="%.9g"))
    elif suffix == "json":
        about = "x, y, z: camera centre in the map, in its unit; qw, qx, qy, qz: camera-to-world; camera z forward"
        frame = results[0].frame
        scale = {"scale": frame.scale.source, "metres_per_unit": frame.world_from_map.scale}
        write_json(path, {"frames": about, **scale, "images": [row for result in results for row in _records(result)]})
    else:
        found = [result for result in results if result.status == LOCALIZED]
        names = [name for result in found for name in result.names]
        poses = [pose for result in found for pose in np.asarray(result.cam_from_world)]
        write_text(path, images_text(names, np.reshape(poses, (-1, 3, 4))))


def _records(result: Localized) -> list[dict[str, Any]]:
    """Return the rows as JSON values, each with its camera and the rows of the rivals."""
    table = result.table().replace([np.inf, np.nan], None)
    rivals = [_records(rival) for rival in result.rivals]
    rows: list[Any] = table.to_dict("records")
    for n, row in enumerate(rows):
        row["camera"] = result.cameras[n].colmap.record() if result.cameras else None
        row["rivals"] = [rival[n] for rival in rivals]
    return rows


def figure_of(result: Localized, landmarks: Float) -> Figure:
    """Draw the matches of a result, and its pose and rivals on a plan of landmarks (N, 3) in the world."""
    from wheretolook.figures.floor_plan import DrawnImage, localization_figure

    images = []
    rival = result.rivals[0].joint if result.rivals else None
    for n, image in enumerate(result.images):
        assert result.joint is not None
        look = result.joint.looks[n]
        inliers = result.joint.inliers[n] if result.joint.inliers else np.zeros(len(look.rows), dtype=bool)
        other = np.zeros((0, 2)) if rival is None else rival.looks[n].pixels[rival.inliers[n]]
        images.append(DrawnImage(image.name, image.rgb, look.pixels, inliers, other))
    to_world = result.frame.world_from_map
    points = to_world.inverse.apply(landmarks) @ to_world.rotation.T
    found = [one for one in (result, *result.rivals) if one.cam_from_world is not None]
    poses = np.array([np.asarray(one.cam_from_world)[0] for one in found]).reshape(-1, 3, 4)
    positions = camera_centers(poses) @ to_world.rotation.T
    axes = poses[:, 2, :3] @ to_world.rotation.T
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    off = np.abs(positions - (low + high) / 2).max(axis=1, initial=0)
    drawn = np.flatnonzero((off < (high - low).max()) | (np.arange(len(off)) == 0))  # wrong poses may be far away
    probabilities = np.array([found[row].probability for row in drawn])
    return localization_figure(images, points, positions[drawn], axes[drawn], probabilities, result.frame)
