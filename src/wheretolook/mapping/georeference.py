"""Scale and georeference of a map: by markers, camera positions, or distances between cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.pose_files import NAME_COLUMNS, NamedRows, locations_of_rows, read_named_rows
from wheretolook.geometry.poses import Float, angle_deg, camera_centers, unit
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.colmap_model import ModelArrays
from wheretolook.mapping.config import (
    MARKER,
    MIN_TRIANGULATION_ANGLE_DEG,
    SCALE_TOLERANCE_PERCENT,
    FrameOptions,
    MarkerConfig,
)
from wheretolook.mapping.photographs import read_photograph
from wheretolook.utils.errors import ConfigError, MapError, TableError
from wheretolook.utils.files import read_json_object
from wheretolook.utils.texts import LOG


@dataclass(frozen=True, eq=False)
class MarkerView:
    """A view of a marker in a photograph with a known pose."""

    image: str  # the photograph's name
    camera: Any  # `pycolmap.Camera`
    cam_from_world: Float  # (3, 4)
    corners_px: Float  # (4, 2), clockwise from the marker's top left; (0.5, 0.5) is the centre of the top-left pixel


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker placed in a map."""

    marker_id: int  # in its dictionary
    corners: Float  # (4, 3), world, in the map's units
    images: tuple[str, ...]  # names of the photographs that see it
    error_px: float  # root mean square reprojection error of its corners

    @property
    def name(self) -> str:
        """Name in reports."""
        return f"marker {self.marker_id}"

    @property
    def sides(self) -> Float:
        """Lengths (4,) of the sides, in the map's units."""
        return np.asarray(np.linalg.norm(np.roll(self.corners, -1, axis=0) - self.corners, axis=1))

    @property
    def center(self) -> Float:
        """Mean of the corners, (3,), in the map's units."""
        return np.asarray(self.corners.mean(0))


def detect_markers(rgb: NDArray[np.uint8], dictionary: str, path: Path | None = None) -> dict[int, Float]:
    """Detect markers in a photograph (H, W, 3) uint8: corners (4, 2) by id, clockwise from the marker's top left.

    (0.5, 0.5) is the centre of the top-left pixel. Raises ConfigError if OpenCV has no such dictionary, MapError if two
    markers have the same id, which would be ambiguous in other photographs.
    """
    import cv2

    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    corners, ids, _ = marker_detector(dictionary).detectMarkers(grey)
    numbers = [] if ids is None else np.asarray(ids).reshape(-1).tolist()
    if len(set(numbers)) < len(numbers):
        fix = "Print every marker once, or choose the markers' dictionary."
        raise MapError("a marker appears twice in this photograph", path=path, value=sorted(numbers), fix=fix)
    refined = (refine_corners(grey, np.asarray(at, np.float64).reshape(4, 2)) for at in corners)
    # OpenCV counts pixels from the centre of the top-left one.
    return {number: at + 0.5 for number, at in zip(numbers, refined, strict=True)}


def place_marker(marker_id: int, views: Sequence[MarkerView]) -> Marker:
    """Place a marker's corners (4, 3) in the map, by least robust reprojection error over its views.

    Raises MapError if fewer than two photographs see the marker, all see it from one direction, or no position fits all
    of them, for instance because the marker was moved or printed twice.
    """
    from scipy.optimize import least_squares

    images = tuple(view.image for view in views)
    start = np.stack([_meeting_point(views, corner) for corner in range(4)])
    centers = camera_centers(np.stack([view.cam_from_world for view in views]))
    rays = unit(start.mean(0) - centers)
    widest_deg = angle_deg((rays @ rays.T).min())
    if not widest_deg >= MIN_TRIANGULATION_ANGLE_DEG:
        problem = (
            f"marker {marker_id} is in photographs from one direction only, {widest_deg:.1f} degrees apart at most"
        )
        raise MapError(problem, value=" ".join(images), fix="Take another photograph of it from another place.")

    def residuals(values: Float) -> Float:
        return np.concatenate([_reprojection(view, values.reshape(4, 3)).ravel() for view in views])

    found = least_squares(residuals, start.ravel(), loss="soft_l1", f_scale=1.0, x_scale="jac")
    error_px = float(np.sqrt(2 * np.mean(residuals(found.x) ** 2)))
    # that of a marker that was moved, or printed twice, is tens of pixels
    limit_px = max(4.0, 1 / 400 * max(max(view.camera.width, view.camera.height) for view in views))
    if not error_px <= limit_px:
        problem = (
            f"no position of marker {marker_id} fits: its corners are off by {error_px:.1f} px, over {limit_px:.1f}"
        )
        fix = "Print every marker once, and leave out photographs from before it was moved."
        raise MapError(problem, value=" ".join(images), fix=fix)
    return Marker(marker_id, found.x.reshape(4, 3), images, error_px)


def _meeting_point(views: Sequence[MarkerView], corner: int) -> Float:
    """The point (3,) with the least sum of squared distances to the rays through a corner."""
    matrix = np.zeros((3, 3))
    vector = np.zeros(3)
    for view in views:
        ray = np.asarray(view.camera.cam_ray_from_img(view.corners_px[corner][None]))[0] @ view.cam_from_world[:, :3]
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        vector += across @ camera_centers(view.cam_from_world)
    return np.asarray(np.linalg.lstsq(matrix, vector, rcond=None)[0])


def _reprojection(view: MarkerView, corners: Float) -> Float:
    """Reprojection errors (4, 2) in pixels of corners (4, 3) in a view."""
    at = corners @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    at[:, 2] = np.maximum(at[:, 2], 1e-9)  # lets the optimization return from behind the camera
    miss: Float = np.asarray(view.camera.img_from_cam(at)) - view.corners_px
    return np.nan_to_num(miss, nan=1e6)


@lru_cache(maxsize=4)
def marker_detector(dictionary: str) -> Any:
    """OpenCV's detector of a dictionary's markers. Raises ConfigError if it has no such dictionary."""
    import cv2

    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if dictionary not in names:
        raise ConfigError("OpenCV has no such dictionary of markers", value=dictionary, fix=f"Use one of {names}.")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.ArucoDetector(markers, parameters)


def refine_corners(grey: NDArray[np.uint8], corners: Float) -> Float:
    """Move a marker's corners (4, 2) to where lines through its edges meet, or not if an edge cannot be made out.

    (0, 0) is the centre of the top-left pixel of the image (H, W) uint8; the corners are right to a pixel or two.
    OpenCV's refinement looks at a window around each corner. Blur rounds a corner off, so that it is found inside the
    square: in rendered images the sides come out 0.6 % short, which would become an error of the map's scale. Blur does
    not move an edge.
    """
    at = np.asarray(corners, dtype=np.float64)
    for _ in range(3):
        lines = [_edge_line(grey, at[side], at[(side + 1) % 4], at.mean(0)) for side in range(4)]
        if any(line is None for line in lines):
            return corners
        homogeneous = np.array([np.cross(lines[side - 1], lines[side]) for side in range(4)])  # type: ignore[arg-type]
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = homogeneous[:, :2] / homogeneous[:, 2:]
        limit = 0.1 * np.linalg.norm(np.roll(at, -1, axis=0) - at, axis=1).min() + 1
        if not np.linalg.norm(moved - corners, axis=1).max() < limit:
            return corners
        at = moved
    return at


def _edge_line(grey: NDArray[np.uint8], start: Float, end: Float, inside: Float) -> Float | None:
    """The line (a, b, c), a x + b y + c = 0, of an edge between dark inside and bright outside; None if there is none.

    In a profile across the edge, the edge is at the mean position of the rise in brightness.
    """
    import cv2

    along = end - start
    length = float(np.linalg.norm(along))
    if length < 4:
        return None
    normal = np.array([-along[1], along[0]]) / length
    if normal @ (inside - start) > 0:
        normal = -normal
    half = float(np.clip(length / 16, 1.5, 6.0))  # within the black frame, a sixth to a tenth of the marker
    across = np.linspace(-half, half, 2 * round(half * 4) + 1)
    n_profiles = 32
    share = np.linspace(0.15, 1 - 0.15, n_profiles)  # where neighbouring edges blur into it
    middle = start + share[:, None] * along
    at = (middle[:, None] + across[:, None] * normal).astype(np.float32)
    profile = cv2.remap(grey.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    rise = np.maximum(np.diff(profile, axis=1), 0)
    total = rise.sum(1)
    strong = total > max(10.0, 0.5 * float(np.median(total)))
    if strong.sum() < n_profiles // 2:
        return None
    offset = (rise[strong] @ ((across[1:] + across[:-1]) / 2)) / total[strong]
    typical = np.abs(offset - np.median(offset))
    near = typical <= max(0.5, 3 * float(np.median(typical)))
    points = middle[strong][near] + offset[near, None] * normal
    center = points.mean(0)
    across_points = np.linalg.svd(points - center)[2][1]
    return np.array([*across_points, -across_points @ center])


REPORT_FILE = "report.json"
DEPTH_M = 5.0
"""Median depth of the images that a map of unknown scale is scaled to: scorers were trained in rooms."""


@dataclass(frozen=True)
class MapScale:
    """The scale of a map; `scale` in its `report.json`."""

    # "model" is unknown, too: that of a model that an earlier version imported
    source: Literal["markers", "distance", "positions", "given", "depth", "rendered", "model", "unknown"] = "unknown"
    factor: float = 1.0  # metres in a unit of COLMAP's frame; where these are unknown, as `scale_from_depths`
    # Error of each marker's side (in percent) or photograph's position (in metres); empty for a single distance.
    residuals: dict[str, float] = field(default_factory=dict)
    unit: Literal["percent", "m", ""] = ""  # of the residuals
    unused: dict[str, str] = field(default_factory=dict)  # markers and photographs that were not used, and why
    marker_error_px: dict[str, float] = field(default_factory=dict)  # root mean square over each marker's corners
    # Number of photographs that see each marker. Two cannot show that the marker was moved between them.
    marker_views: dict[str, int] = field(default_factory=dict)

    @property
    def is_metric(self) -> bool:
        """Whether the map is in metres."""
        return self.source not in ("unknown", "model")

    @property
    def is_missing(self) -> bool:
        """Whether the map is in any unit, as an earlier version left maps of unknown scale."""
        return not self.is_metric and self.factor == 1

    def describe(self) -> str:
        """One clause for a log."""
        parts = [f"scale: {self.source}"]
        if self.residuals:
            errors = np.abs(list(self.residuals.values()))
            parts.append(
                f"errors {np.median(errors):.3g} {self.unit} (median), {errors.max():.3g} {self.unit} (maximum)"
            )
        if self.marker_error_px:
            parts.append(f"corners within {max(self.marker_error_px.values()):.2g} px")
        if self.marker_views and max(self.marker_views.values()) <= 2:
            parts.append("NOT CHECKED: no marker is seen in more than two photographs")
        if self.unused:
            parts.append(f"not used: {', '.join(self.unused)}")
        return "; ".join(parts)


class MarkedPhotographs(NamedTuple):
    """Photographs in which markers are detected."""

    markers: MarkerConfig = MarkerConfig()
    folder: Path | None = None
    turned: bool = True  # as EXIF says, see `read_photograph`
    progress: bool = True


def check_tables(markers: MarkerConfig, frame: FrameOptions) -> None:
    """Raise TableError if a table of markers or positions is not valid, ConfigError if OpenCV lacks the dictionary."""
    if markers.has_sizes or frame.marker_ids:
        marker_detector(markers.dictionary)
    if markers.marker_table is not None:
        read_marker_table(markers.marker_table)
    if frame.positions is not None:
        read_positions(frame.positions)


def given_scale(model: Any, frame: FrameOptions, photographs: MarkedPhotographs, path: Path) -> MapScale | None:
    """The scale of a `pycolmap.Reconstruction` in `path` by the options of its frame, or by markers of known size.

    None if there is none, or positions give it. Raises MapError or ConfigError if the source does not give it.
    """
    if frame.scale is not None:
        return MapScale("given", float(frame.scale))
    markers = photographs.markers
    views: dict[int, list[MarkerView]] = {}
    images = [image for _, image in sorted(model.images.items()) if image.has_pose]
    if markers.has_sizes or frame.marker_ids:
        if photographs.folder is None:
            fix = "Give the folder of the model's images, --images, or a distance between photographs, or positions."
            raise ConfigError("markers are detected in photographs, and none were given", fix=fix)
        for image in tqdm(images, "map: markers", disable=not photographs.progress, unit="image"):
            for marker, view in _marker_views(image, photographs).items():
                views.setdefault(marker, []).append(view)
    if frame.distance is not None:
        centers = {image.name: image.projection_center() for image in images}
        first, second = (_end_point(end, centers, views, path) for end in frame.ends)
        return scale_from_distance(first, second, frame.distance[2])
    if not markers.has_sizes:
        return None
    sizes = markers.marker_size_m if markers.marker_table is None else read_marker_table(markers.marker_table)
    placed, unused = _place_markers(views, sizes)
    return scale_from_markers(placed, sizes, unused)


def fit_similarity(source: ArrayLike, target: ArrayLike) -> Similarity:
    """The similarity that maps points (N, 3) to points (N, 3) with the least sum of squared errors.

    Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", TPAMI 1991. Raises
    MapError for fewer than three points, or points on a line.
    """
    import pycolmap

    a = np.asarray(source, dtype=np.float64)
    b = np.asarray(target, dtype=np.float64)
    # of the largest spread
    ranks = [np.linalg.matrix_rank(points - points.mean(0), rtol=1e-6) if len(points) else 0 for points in (a, b)]
    sim3d = pycolmap.estimate_sim3d(a, b) if len(a) >= 3 and min(ranks) >= 2 else None
    if sim3d is None:
        fix = "Give the positions of three photographs or more, not on a line."
        problem = "these positions do not determine a frame" if len(a) else "no position has the name of an image"
        raise MapError(problem, value=len(a), fix=fix)
    return Similarity(float(sim3d.scale), np.asarray(sim3d.rotation.matrix()), np.asarray(sim3d.translation))


def scale_from_markers(
    markers: Sequence[Marker], size_m: Mapping[int, float] | float, unused: Mapping[str, str] = {}
) -> MapScale:
    """The median of true size over length in the map, over the sides of all markers.

    `size_m` is the side of all markers, or of each by its id; `unused` are markers that could not be placed, and why.
    Raises MapError if there is no marker, or the error of a side exceeds the tolerance.
    """
    if not markers:
        reasons = "; ".join(unused.values()) or "no marker of a known size was detected"
        fix = "Check scale.dictionary and the sizes; at least two photographs must show a whole marker."
        raise MapError("no marker gives the map its scale", value=reasons, fix=fix)
    sizes = np.array([size_m if isinstance(size_m, float | int) else size_m[marker.marker_id] for marker in markers])
    lengths = np.stack([marker.sides for marker in markers])
    factor = float(np.median(sizes[:, None] / lengths))
    errors = dict(zip(markers, 100 * (factor * lengths / sizes[:, None] - 1), strict=True))
    wrong = [
        f"{marker.name}: {sides.round(1)} %"
        for marker, sides in errors.items()
        if np.abs(sides).max() > SCALE_TOLERANCE_PERCENT
    ]
    if wrong:
        problem = f"the markers do not agree on a scale: sides are wrong by more than {SCALE_TOLERANCE_PERCENT:g} %"
        fix = "Measure the black squares; give markers of different sizes in a marker_table."
        raise MapError(problem, value=wrong, fix=fix)
    return MapScale(
        source="markers",
        factor=factor,
        residuals={
            f"{marker.name} side {i}": float(side) for marker in markers for i, side in enumerate(errors[marker])
        },
        unit="percent",
        unused=dict(unused),
        marker_error_px={marker.name: marker.error_px for marker in markers},
        marker_views={marker.name: len(set(marker.images)) for marker in markers},
    )


def scale_from_distance(first: ArrayLike, second: ArrayLike, distance_m: float) -> MapScale:
    """The scale at which two points (3,) of the map are `distance_m` apart. Raises MapError if they coincide."""
    length = float(np.linalg.norm(np.asarray(first) - np.asarray(second)))
    if not length > 0:
        raise MapError("the two ends of the known distance coincide", value=length, fix="Name two different ends.")
    return MapScale("distance", distance_m / length)


def scale_from_depths(arrays: ModelArrays, cam_from_world: Float) -> MapScale:
    """The scale, unknown, at which the median depth of images with poses (I, 3, 4) is `DEPTH_M`; 1 without landmarks."""
    depth = median_depths(arrays, cam_from_world)
    depth = depth[depth > 0]  # none where nothing is observed
    return MapScale("unknown", DEPTH_M / float(np.median(depth)) if len(depth) else 1.0)


def median_depths(arrays: ModelArrays, cam_from_world: Float) -> Float:
    """Median depth (I,) of the landmarks that each image observes, from poses (I, 3, 4); NaN where it observes none."""
    point = arrays.points[arrays.observation_point]
    axis = cam_from_world[arrays.observation_image, 2]
    depth = (axis[:, :3] * point).sum(1) + axis[:, 3]
    ordered = depth[np.lexsort((depth, arrays.observation_image))]
    counts = np.bincount(arrays.observation_image, minlength=len(cam_from_world))
    some = counts > 0
    first = np.cumsum(counts)[some] - counts[some]
    result = np.full(len(counts), np.nan)
    result[some] = (ordered[first + (counts[some] - 1) // 2] + ordered[first + counts[some] // 2]) / 2
    return result


def scale_from_positions(centers: Mapping[str, Float], positions: Mapping[str, Float]) -> tuple[MapScale, Similarity]:
    """The scale, and the similarity from camera centres in the map to known positions in metres, by photograph.

    The tolerance is a share of the diagonal of the box around the positions used. The worst positions beyond it are left
    out, up to 5 %, with a warning. Raises MapError if fewer than three photographs are in the map, all are
    on a line, or the error of another exceeds the tolerance.
    """
    names = [name for name in positions if name in centers]
    unused = {name: "not in the map" for name in positions if name not in centers}
    if not names and positions and centers:
        value = f"{next(iter(positions))}; images are named like {next(iter(centers))}"
        raise MapError("no position is that of an image in the map", value=value, fix="Name the images as in the map.")
    for removable in range(int(0.05 * len(names)), -1, -1):
        source = np.array([centers[name] for name in names]).reshape(-1, 3)
        target = np.array([positions[name] for name in names]).reshape(-1, 3)
        similarity = fit_similarity(source, target)
        errors_m = np.linalg.norm(similarity.apply(source) - target, axis=1).tolist()
        residuals = dict(zip(names, errors_m, strict=True))
        limit_m = SCALE_TOLERANCE_PERCENT / 100 * float(np.linalg.norm(np.ptp(target, axis=0)))
        wrong = sorted((name for name in names if residuals[name] > limit_m), key=lambda name: -residuals[name])
        if not wrong:
            break
        if removable == 0:
            limit = f"{limit_m:.3g} m, {SCALE_TOLERANCE_PERCENT:g} % of their extent"
            value = ", ".join(f"{name}: {residuals[name]:.3g} m" for name in wrong[:5])
            fix = "Check the first one's position, and the units (metres, not degrees) and names of all."
            raise MapError(f"the positions do not fit the map: errors exceed {limit}", value=value, fix=fix)
        names.remove(wrong[0])
        unused[wrong[0]] = f"{residuals[wrong[0]]:.3g} m off"
        LOG.warning("the position of %s is left out: it is %s", wrong[0], unused[wrong[0]])
    return MapScale("positions", similarity.scale, residuals, "m", unused), similarity


def read_marker_table(path: Path) -> dict[int, float]:
    """Read the side in metres of each marker by its id, from a CSV file with the columns `id` and `size_m`.

    Raises TableError if the file is missing or not such a table, or a marker has two sizes.
    """
    table = read_named_rows(path)
    rows = _by_name(table, table.numbers(["size_m"]))
    if not all(name.isdecimal() and size > 0 for name, (size,) in rows.items()):
        raise TableError("not a table of markers' ids and positive sizes", path=path, fix="Write 7,0.15.")
    return {int(name): float(size) for name, (size,) in rows.items()}


def read_positions(path: str | Path) -> dict[str, Float]:
    """Read positions (3,) in metres by photograph, in any of `wheretolook.geometry.pose_files.FORMATS` with names.

    Raises TableError if the file is missing or not such a table, or a photograph has two positions.
    """
    table = read_named_rows(path)
    LOG.info("positions: %s (%s)", path, table.format)
    return _by_name(table, locations_of_rows(table))


def _by_name(table: NamedRows, values: Float) -> dict[str, Float]:
    """Return the values (N, C) of rows by name. Raises TableError if there are no names, or a name has two values."""
    if not {*NAME_COLUMNS} & {*table.columns}:
        fix = "Give a column image, such as image,x,y,z or 'a.jpg 1 2 3'."
        raise TableError("the rows have no names", path=table.path, value=",".join(table.header), fix=fix)
    result: dict[str, Float] = {}
    for row, (name, value) in enumerate(zip(table.names, values, strict=True)):
        if not np.array_equal(result.setdefault(name, value), value):
            raise TableError("a name has different values", path=table.path, value=f"{table.label(row)}: {name}")
    return result


def read_scale(map_dir: Path) -> MapScale | None:
    """Read the scale in a map's report; None for maps of known poses, which are metric. Raises MapError if damaged."""
    path = map_dir / REPORT_FILE
    try:
        record = read_json_object(path).get("scale")
        return None if record is None else MapScale(**record)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError) as error:
        raise MapError(f"the map's report is damaged: {error}", path=path, fix="Run the map stage again.") from error


def _marker_views(image: Any, photographs: MarkedPhotographs) -> dict[int, MarkerView]:
    """Views of markers in the photograph of an image with a pose: detected at full size, in pixels of the map."""
    camera = image.camera
    assert photographs.folder is not None
    path = photographs.folder / image.name
    rgb = read_photograph(path, photographs.turned)
    reduction = np.array([camera.width, camera.height]) / rgb.shape[1::-1]
    pose = image.cam_from_world().matrix()
    corners = detect_markers(rgb, photographs.markers.dictionary, path)
    return {marker: MarkerView(image.name, camera, pose, at * reduction) for marker, at in corners.items()}


def _place_markers(
    views: Mapping[int, list[MarkerView]], sizes_m: Mapping[int, float] | float
) -> tuple[list[Marker], dict[str, str]]:
    """Markers of known size placed in the map, and why others were not: one false detection must not stop the map."""
    markers = []
    unused = {}
    for marker, views_of_it in sorted(views.items()):
        if isinstance(sizes_m, float | int) or marker in sizes_m:
            try:
                markers.append(place_marker(marker, views_of_it))
            except MapError as error:
                unused[f"marker {marker}"] = f"{error.problem}: {error.value}"
    return markers, unused


def _end_point(end: str, centers: Mapping[str, Float], views: Mapping[int, list[MarkerView]], path: Path) -> Float:
    """Position (3,) of an end of a known distance, in the map's frame."""
    if end.startswith(MARKER):
        number = int(end.removeprefix(MARKER))
        if number not in views:
            raise MapError(f"no photograph with a pose sees marker {number}", path=path, fix="Name another one.")
        return place_marker(number, views[number]).center
    if end not in centers:
        fix = f"Name two of its images, such as {', '.join(sorted(centers)[:2])}; markers are written marker:7."
        raise MapError("the map has no such image", path=path, value=end, fix=fix)
    return centers[end]
