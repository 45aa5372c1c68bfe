"""The frame of a map: scale, direction up as its cameras were held, and checks that both are plausible."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float, angle_deg, camera_centers
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.colmap_model import ModelArrays, colmap_poses, model_arrays
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.georeference import (
    DEPTH_M,
    REPORT_FILE,
    MapScale,
    MarkedPhotographs,
    given_scale,
    read_positions,
    read_scale,
    scale_from_depths,
    scale_from_positions,
)
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, SceneError, reject
from wheretolook.utils.files import read_json_object

if TYPE_CHECKING:
    from wheretolook.rendering.raycasting import MeshRaycaster


_MIN_RESIDUAL = np.sin(np.radians(0.5))  # limits the weights


@dataclass(frozen=True, eq=False)
class Gravity:
    """The direction up, and how well the photographs agree on it."""

    up: Float  # (3,) unit vector in the frame of the poses
    # "level": the direction most nearly perpendicular to the images' x axes. "mean": the cameras rotated too little for
    # that, so it is the mean of the images' own up directions. "given": the direction in the camera was given.
    method: Literal["level", "mean", "given"]
    residual_deg: Float  # (M,) roll of each photograph for "level", else the angle between its own up and `up`

    @property
    def rotation(self) -> Float:
        """The smallest rotation (3, 3) from `up` to z."""
        return rotation_to_z(self.up)


def estimate_gravity(cam_from_world: ArrayLike, up_in_camera: tuple[float, float, float] | None = None) -> Gravity:
    """Estimate the direction up from poses (M, 3, 4), or from up in the camera frame if that is known.

    People tilt a camera up and down but hardly roll it, so the images' x axes are level: up is the direction d with the
    least sum of |x . d|, which a minority of rolled photographs does not move. Iteratively reweighted least squares.
    """
    rotation = np.asarray(cam_from_world, dtype=np.float64)[:, :, :3]
    direction = np.array([0.0, -1.0, 0.0]) if up_in_camera is None else np.asarray(up_in_camera, dtype=np.float64)
    ups = np.einsum("mji,j->mi", rotation, direction / np.linalg.norm(direction))
    mean = _median_direction(ups)
    if up_in_camera is None:
        level = _level_direction(rotation[:, 0])
        if level is not None:
            up = level if level @ mean > 0 else -level
            return Gravity(up, "level", np.degrees(np.arcsin(np.clip(np.abs(rotation[:, 0] @ up), 0, 1))))
    residual_deg = angle_deg(ups @ mean)
    return Gravity(mean, "mean" if up_in_camera is None else "given", residual_deg)


def rotation_to_z(up: ArrayLike) -> Float:
    """The smallest rotation (3, 3) from a direction (3,) to z; about x if it points straight down."""
    a = np.asarray(up, dtype=np.float64)
    x, y, z = a / np.linalg.norm(a)
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + z))


def _level_direction(axes: Float) -> Float | None:
    """The direction most nearly perpendicular to unit axes (M, 3); None if they do not determine it."""
    weights = np.ones(len(axes))
    for _ in range(50):
        values, vectors = np.linalg.eigh((axes.T * weights) @ axes / weights.sum())
        weights = 1 / np.maximum(np.abs(axes @ vectors[:, 0]), _MIN_RESIDUAL)
    least, middle = np.sqrt(np.maximum(values[:2], 0))
    # of the x axes within the level plane
    return vectors[:, 0] if middle > np.sin(np.radians(5)) and middle > 3 * least else None


def _median_direction(directions: Float) -> Float:
    """The unit vector with nearly the least sum of angles to unit vectors (M, 3): Weiszfeld's iteration on a sphere."""
    at: Float = directions.mean(0)
    for _ in range(50):
        at = at / max(float(np.linalg.norm(at)), 1e-12)
        weights = 1 / np.maximum(np.linalg.norm(directions - at, axis=1), _MIN_RESIDUAL)
        at = (directions * weights[:, None]).sum(0) / weights.sum()
    return at / max(float(np.linalg.norm(at)), 1e-12)


LOOKING_DOWN = 0.7  # mean of the cameras' axes along -z above which their roll does not determine up


def check_overlap(mesh: str | Path, points: ArrayLike, bounds: Float) -> None:
    """Raise SceneError if the box of a mesh (2, 3) and that of most landmarks (N, 3), in its unit, do not overlap."""
    box = np.quantile(np.asarray(points, dtype=np.float64), (0.01, 0.99), axis=0)
    shared = np.minimum(box[1], bounds[1]) - np.maximum(box[0], bounds[0])
    # a floor that both share does not count
    if (shared < 0.1 * np.minimum(np.ptp(box, axis=0), np.ptp(bounds, axis=0))).any():
        named = (("mesh", bounds), ("landmarks", box))
        value = "; ".join(f"{what} {_rounded(low)} to {_rounded(high)}" for what, (low, high) in named)
        fix = "Export both in the same frame and unit; --mesh-up y turns a mesh with y up (glTF's own)."
        raise SceneError("the mesh and the map do not overlap", path=mesh, value=value, fix=fix)


def warn_of_mesh(mesh: str | Path, points: ArrayLike, raycaster: MeshRaycaster) -> None:
    """Issue a `MapWarning` if a map's landmarks (N, 3) m seem not to be in the frame or unit of a mesh.

    Raises SceneError as `check_overlap`.
    """
    check_overlap(mesh, points, raycaster.bounds)
    if message := mesh_warning(points, raycaster):
        warnings.warn(f"{mesh}: {message}", MapWarning, stacklevel=2)


def mesh_warning(points: ArrayLike, raycaster: MeshRaycaster) -> str:
    """Message if a mesh seems not to be in a map's frame and unit, because landmarks (N, 3) m are far from it; else ""."""
    at = np.asarray(points, dtype=np.float64)
    at = at[:: max(1, -(-len(at) // 10_000))]  # points are enough for a median
    farthest_m = 100.0
    off_m = float(np.median(raycaster.distance_to_surface(at, farthest_m)))
    if not off_m > 0.3:
        return ""
    far = f"{off_m:.2f} m or more" if np.isfinite(off_m) else f"more than {farthest_m:g} m"
    return (
        f"half of the landmarks are {far} from the mesh, so it seems to be in another frame or unit than the model. "
        "Export both in the same frame and unit; --mesh-up y turns a mesh with y up (glTF's own)"
    )


def scale_warning(mapping_distance_m: ArrayLike, centers: ArrayLike) -> str:
    """Message if a map seems not to be in metres; else "".

    Takes the mean distance of each landmark's mapping cameras (N,), and the cameras' centres (M, 3).
    """
    from scipy.spatial import cKDTree  # takes longer than all of --help

    distance = float(np.median(np.asarray(mapping_distance_m)))
    at = np.asarray(centers, dtype=np.float64)
    spacing = float(np.median(cKDTree(at).query(at, 2)[0][:, 1])) if len(at) > 1 else 0.0
    max_spacing_m = 5.0
    low, high = 0.2, 50.0  # from tabletops to plazas
    if low <= distance <= high and spacing <= max_spacing_m:
        return ""
    lengths = f"landmarks are {distance:.3g} m from the cameras that mapped them, and these {spacing:.3g} m from the "
    lengths += f"nearest other (medians); plausible are {low:g} to {high:g} m, and at most {max_spacing_m:g} m"
    fix = "Correct --scale, --distance or --positions. Ignore this warning if it is metric"
    return f"the model seems not to be in metres: {lengths}. {fix}"


def up_axis_warning(cam_from_world: ArrayLike, world_from_map: Similarity = Similarity()) -> str:
    """Message if z seems not to be up in the world, by the poses (M, 3, 4) of the cameras; else "".

    Directions in it are in the map's own frame, in which `--up` takes them.
    """
    poses = np.asarray(cam_from_world, dtype=np.float64)
    gravity = estimate_gravity(poses)
    off_deg = float(angle_deg(gravity.up[2]))
    # people roll a camera by a few degrees, but may tilt all their photographs of an object
    if off_deg <= {"level": 25.0, "mean": 50.0}[gravity.method] or poses[:, 2, 2].mean() < -LOOKING_DOWN:
        return ""
    how = "on their side" if off_deg > 45 else "askew"
    if off_deg > 135:
        how = "upside down"
    up, given = gravity.up @ world_from_map.rotation, world_from_map.rotation[2]
    return (
        f"the cameras are {how}: the up direction estimated from their orientations is ({_rounded(up)}), "
        f"{off_deg:.0f} degrees from ({_rounded(given)}), which is up here. --up level turns it upright. Ignore this warning if the "
        "cameras were held so"
    )


@dataclass(frozen=True, eq=False)
class MapFrame:
    """A map's own frame, in which users give and get coordinates, and the world: metres, z up.

    In the world of a map of unknown scale, the median depth of its images is `DEPTH_M`.
    """

    world_from_map: Similarity = Similarity(1.0, np.eye(3), np.zeros(3))
    scale: MapScale = MapScale("given")  # its source; the factor is that of `world_from_map`
    gravity: Literal["given", "levelled", "model"] = "model"
    tilt_deg: float = 0.0  # angle between z and up as estimated from the cameras' roll

    def of_arrays(self, arrays: ModelArrays) -> ModelArrays:
        """Return arrays of the model in the world."""
        to_world = self.world_from_map
        return replace(
            arrays,
            points=to_world.apply(arrays.points),
            image_poses=to_world.apply_to_poses(arrays.image_poses),
            image_centers=to_world.apply(arrays.image_centers),
        )

    @property
    def is_turned(self) -> bool:
        """Whether the axes of the map are not those of the world."""
        return not np.allclose(self.world_from_map.rotation, np.eye(3), atol=1e-3)

    def check_metric(self, what: str) -> None:
        """Raise ConfigError, which names what is in metres, if the map's unit is unknown."""
        problem = f"{what} in metres, and the unit of the map is unknown: give --scale, --distance or --positions"
        reject((not self.scale.is_metric, problem, None))

    @property
    def unit(self) -> str:
        """Name of the unit of the map's coordinates."""
        return "m" if self.scale.is_metric and self.world_from_map.scale == 1 else "map units"

    @property
    def angle_columns(self) -> dict[str, str]:
        """Directions in the map where pitch_deg is 90 and yaw_deg 0, as columns of tables; none if they are z and x."""
        rotation = self.world_from_map.rotation
        return {"up": _rounded(rotation[2], 6), "yaw_zero": _rounded(rotation[0], 6)} if self.is_turned else {}

    def record(self) -> dict[str, Any]:
        """Return the frame as JSON values, from which `read_frame` makes it."""
        similarity = self.world_from_map
        arrays = {"rotation": similarity.rotation.tolist(), "translation": similarity.translation.tolist()}
        return {"world_from_map": {"scale": similarity.scale, **arrays}, "gravity": self.gravity}

    def describe(self) -> str:
        """State a known scale and the direction up in one clause."""
        up = "z" if self.gravity == "model" else f"({_rounded(self.world_from_map.rotation[2])}), {self.gravity}"
        unit = f"1 unit of the map = {self.world_from_map.scale:.4g} m ({self.scale.describe()}), "
        tilt = f", {self.tilt_deg:.0f} degrees from that of its cameras" if self.tilt_deg > 5.0 else ""
        return f"{unit if self.scale.is_metric else ''}up: {up}{tilt}"

    def warn(self, model: Path, mapping_distance_m: ArrayLike, cam_from_world: ArrayLike) -> None:
        """Issue a `MapWarning` for each of the `messages`."""
        for message in self.messages(mapping_distance_m, cam_from_world):
            warnings.warn(f"{model}: {message}", MapWarning, stacklevel=3)

    def messages(self, mapping_distance_m: ArrayLike, cam_from_world: ArrayLike) -> tuple[str, ...]:
        """Return what was assumed of the map, or seems wrong of a known scale and direction up: a sentence each.

        Takes the mean distance of each landmark's mapping cameras (N,) m, and the poses (M, 3, 4) of all in the world.
        """
        scale = scale_warning(mapping_distance_m, camera_centers(cam_from_world)) if self.scale.is_metric else ""
        up = "" if self.gravity == "levelled" else up_axis_warning(cam_from_world, self.world_from_map)
        return (*self.doubts, *filter(None, (scale, up)))

    @property
    def doubts(self) -> tuple[str, ...]:
        """What was assumed of the map, and how to state it instead: a sentence each."""
        doubts = []
        if not self.scale.is_metric:
            depth = f"the median depth of the images were {DEPTH_M:g} m (1 unit = {self.world_from_map.scale:.4g} m)"
            doubts.append(f"scale unknown: scored as if {depth}; give --scale, --distance or --positions")
        if self.gravity == "levelled":
            up = f"up is ({_rounded(self.world_from_map.rotation[2])}) in the map, as its cameras were held"
            doubts.append(f"{up}; --up z keeps the map's z")
        return tuple(doubts)


def find_frame(
    model_dir: Path,
    model: Any,
    options: FrameOptions = FrameOptions(),
    depth_scale: float | None = None,
    arrays: ModelArrays | None = None,
    photographs: MarkedPhotographs = MarkedPhotographs(),
) -> MapFrame:
    """Find the frame of a `pycolmap.Reconstruction`, which is not changed.

    Args:
        model_dir: its folder, whose report states the scale if the map is one of this project.
        model: the reconstruction.
        options: what the user states.
        depth_scale: metres in a unit of the model by depth images, if there are any.
        arrays: the reconstruction as arrays, if they are known.
        photographs: its images, with markers of known size or at the ends of the distance.

    Raises:
        MapError: the options do not fit the images, or no camera agrees with the direction up.
        ConfigError: two sources of the scale disagree, or the file of positions is not valid.
    """
    poses = colmap_poses(model_dir, model)
    reported = reported_scale(model_dir)
    scale = given_scale(model, options, photographs, model_dir)
    known = reported if reported is not None and reported.is_metric else None
    by_depth = None if depth_scale is None else MapScale("depth", depth_scale)
    level = estimate_gravity(poses)
    if options.positions is not None:
        centers = {image.name: image.projection_center() for image in model.images.values() if image.has_pose}
        scale, similarity = scale_from_positions(centers, read_positions(options.positions))
        _check_agreement(scale, known, by_depth)
        return MapFrame(similarity, scale, "given", _tilt_deg(similarity.rotation, level))
    _check_agreement(scale or known, known, by_depth)
    chosen = scale or known or by_depth or reported or scale_from_depths(arrays or model_arrays(model), poses)
    gravity, rotation = _upright(model_dir, poses, options, level, is_known=reported is not None)
    return MapFrame(Similarity(chosen.factor, rotation, np.zeros(3)), chosen, gravity, _tilt_deg(rotation, level))


def _tilt_deg(rotation: Float, level: Gravity) -> float:
    """Angle between the z axis of a rotated map and up as its cameras were held."""
    return float(angle_deg(rotation[2] @ level.up))


def reported_scale(model_dir: Path) -> MapScale | None:
    """Read how the scale of a map of this project is known, whose unit it is; None if it is in any unit."""
    scale = read_scale(model_dir)
    if scale is not None:
        return None if scale.is_missing else replace(scale, factor=1.0)
    path = model_dir / REPORT_FILE
    return MapScale("rendered") if path.is_file() and "n_landmarks" in read_json_object(path) else None


def has_photographs(model_dir: Path) -> bool:
    """Return whether the images of a model are photographs: all but those that its report states as rendered."""
    scale = reported_scale(model_dir)
    return scale is None or scale.source != "rendered"


def read_frame(map_dir: Path) -> MapFrame:
    """Read the own frame of the model that a map was imported from, from its report; of other maps, their own.

    Raises MapError if the report is damaged, or the map is in any unit.
    """
    scale = read_scale(map_dir)
    if scale is None:
        return IDENTITY
    record = read_json_object(map_dir / REPORT_FILE).get("frame")
    if record is None:
        if scale.is_missing:
            raise MapError("the unit of this map is unknown", path=map_dir, fix="Run `wheretolook map` again.")
        return MapFrame(scale=scale)
    values = record["world_from_map"]
    similarity = Similarity(values["scale"], np.array(values["rotation"]), np.array(values["translation"]))
    return MapFrame(similarity, scale, record["gravity"])


def _check_agreement(scale: MapScale | None, reported: MapScale | None, by_depth: MapScale | None) -> None:
    """Raise ConfigError if a scale differs from the reported one, or from that of depth images."""
    # depth sensors are less accurate
    limits = ((reported, 1.05, "Leave it out"), (by_depth, 1.2, "Check --depth-scale"))
    for other, limit, fix in limits:
        if scale is not None and other is not None and abs(np.log(scale.factor / other.factor)) > np.log(limit):
            value = ", ".join(f"{one.source}: 1 unit = {one.factor:.4g} m" for one in (scale, other))
            raise ConfigError(
                "the scale of the map has two different values", value=value, fix=f"{fix}, or correct it."
            )


def _upright(
    model_dir: Path, poses: Float, options: FrameOptions, level: Gravity, is_known: bool
) -> tuple[Literal["given", "levelled", "model"], Float]:
    """Return how the direction up is known, and the rotation (3, 3) that turns it to z.

    `level` is up as the cameras were held. Without options it is z if that is known, or unless the cameras, poses
    (M, 3, 4), are clearly not level. A user who states that z is up keeps it, however the cameras were held.
    """
    up = options.up_direction()
    if up is None:
        levels = options.up == "level" or not (is_known or not up_axis_warning(poses))
        return ("levelled", level.rotation) if levels else ("model", np.eye(3))
    rotation = rotation_to_z(up)
    off_deg = angle_deg(-poses[:, 1, :3] @ rotation[2])
    looking_down = (poses[:, 2, :3] @ rotation[2]).mean() < -LOOKING_DOWN
    if rotation[2, 2] != 1 and np.median(off_deg) > 60 and not looking_down:  # no camera was held like that
        problem = (
            f"no camera agrees with this direction up: half were held {np.median(off_deg):.0f} degrees off or more"
        )
        fix = f"The cameras were held as if up were ({_rounded(level.up)}): give that, or --up level."
        raise MapError(problem, path=model_dir, value=options.up, fix=fix)
    return "given", rotation


def _rounded(direction: Float, digits: int = 2) -> str:
    return " ".join(f"{value:.{digits}f}" for value in np.round(direction, digits) + 0.0)  # no -0.00


IDENTITY = MapFrame()
"""The frame of a map that is in metres with z up."""
