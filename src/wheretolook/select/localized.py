"""Images to localize, and their localized poses as tables and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from wheretolook.dataset.config import CONTRADICTED, LOCALIZED, NO_POSE
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.pose_files import images_text
from wheretolook.geometry.poses import Float, camera_centers, pan_tilt_angles, quaternion_from_rotation
from wheretolook.localization.rig_localization import JointLocalization
from wheretolook.mapping.map_frame import IDENTITY, MapFrame
from wheretolook.select.query_images import QueryImage, is_panorama
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import write_json, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        cameras: of the images, as keypoints were extracted; an assumed focal length is refined with the pose.
        cameras_from: which camera each is and why, see `QueryImage.camera_from`; "assumed: ..." if it is not known.
        features_from: the extractor of their keypoints, see `ImageLocalizer.features_from`; "assumed: ..." as well.
        images: the images themselves; of a panorama its cut-outs.
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
    cameras_from: tuple[str, ...] = field(default=(), repr=False)
    features_from: str = field(default="", repr=False)
    images: tuple[QueryImage, ...] = field(default=(), repr=False)
    joint: JointLocalization | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls,
        images: Sequence[QueryImage],
        joint: JointLocalization,
        probabilities: Float,
        frame: MapFrame,
        features_from: str = "",
    ) -> Localized:
        """Convert a joint localization and the probabilities (1 + rivals,) of its poses to the map's own frame."""
        names = tuple(image.name for image in images)
        unit = frame.world_from_map.scale
        values: dict[str, Any] = {"names": names, "frame": frame, "images": tuple(images), "joint": joint}
        values["cameras"] = tuple(look.camera for look in joint.looks)
        values["cameras_from"] = tuple(image.camera_from for image in images)
        values["features_from"] = features_from
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
            cls.of(images, rival, p, frame, features_from)
            for rival, p in zip(joint.rivals, probabilities[1:, None], strict=True)
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

    def of_panorama(self, panorama: QueryImage) -> Localized:
        """Convert the result of a panorama's cut-outs, of which the first has its axes, to that of the panorama."""
        return replace(
            self,
            names=(panorama.name,),
            cam_from_world=None if self.cam_from_world is None else self.cam_from_world[:1],
            cameras=(panorama.camera,),
            cameras_from=(panorama.camera_from,),
            rivals=tuple(rival.of_panorama(panorama) for rival in self.rivals),
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
        return f"({at}), probability {self.probability:.3f}{rivals}; {matches}{doubt}{self._describe_camera()}"

    def _describe_camera(self) -> str:
        """State the focal length of an assumed camera, and what it was assumed to be."""
        if not self.cameras_from or not self.cameras_from[0].startswith("assumed") or is_panorama(self.cameras[0]):
            return ""
        return f"; camera {self.cameras_from[0]}, refined to {self.cameras[0].colmap.mean_focal_px:.0f} px"

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
                "camera_from": self.cameras_from or "",
                "features_from": self.features_from,
                "focal_px": [camera.colmap.mean_focal_px for camera in self.cameras] or np.nan,
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
