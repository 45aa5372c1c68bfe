"""Options of the map stage, for rendered images, photographs and existing models."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from math import inf
from pathlib import Path
from typing import Any, ClassVar, Literal

from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import CameraConfig
from wheretolook.utils.errors import ConfigError, check_positive, check_range, no_option, reject


@dataclass(frozen=True)
class WalkStyle:
    """The walk of a person with a hand-held camera through a scene, part of the keys of finished maps.

    Attributes:
        coverage: share of the reachable floor that is visited; the walk ends there.
        image_spacing_m: largest distance along the walk between two images; farther apart they overlap too little.
        eye_height_m: mean height of the camera above the floor.
        swing_deg: how far the camera swings to either side of the walk.
        pitch_deg: mean pitch, negative is down.
        visit_radius_m: floor within this walking distance counts as visited; it grows until images are close enough.
        eye_height_variation_m: largest deviation of the camera's height.
        cell_m: grid spacing of the walk, well below a door's width.
        max_step_height_m: largest difference in floor height between neighbouring cells: two steps of stairs.
        swing_period: images in one swing from left to right and back, so that neighbours overlap.
        pitch_variation_deg: largest deviation of the camera's pitch.
    """

    coverage: float = 0.7
    image_spacing_m: float = 0.6
    eye_height_m: float = 1.45
    swing_deg: float = 40.0
    pitch_deg: float = -5.0
    visit_radius_m: float = 1.0
    eye_height_variation_m: float = 0.2
    cell_m: float = 0.3
    max_step_height_m: float = 0.4
    swing_period: float = 12.0
    pitch_variation_deg: float = 10.0


WALK = WalkStyle()


PARTNERS = 10  # images that each image is matched with; time grows with their number
MAX_EPIPOLAR_ERROR_PX = 2.0  # matches farther from the epipolar line are dropped; keypoints are accurate to a pixel
MIN_TRIANGULATION_ANGLE_DEG = 1.5  # COLMAP's own limit
EXHAUSTIVE_UP_TO = 60  # photographs of which all pairs are matched, in minutes; of more the most similar ones
MARKER = "marker:"  # before the id of a marker as the end of a distance
# Of a marker's side, or of the extent of known positions; a wrong size or name is off by more.
SCALE_TOLERANCE_PERCENT = 5.0


@dataclass(frozen=True)
class MarkerConfig:
    """Markers of known size in the photographs of a map, which give its scale.

    Args:
        dictionary: OpenCV's name of the markers' dictionary. DICT_4X4_50, DICT_APRILTAG_36H11, DICT_ARUCO_ORIGINAL
            and so on.
        marker_size_m: side of the black square of every marker, in metres; 0 for no markers.
        marker_table: CSV file of markers of different sizes, with the columns `id` and `size_m`. Other markers are
            ignored.
    """

    dictionary: str = "DICT_4X4_50"
    marker_size_m: float = 0.0
    marker_table: Path | None = None

    def __post_init__(self) -> None:
        check_range("marker_size_m", self.marker_size_m, 0)
        if self.marker_size_m > 0 and self.marker_table is not None:
            raise ConfigError("give marker_size_m or marker_table, not both", value=self.marker_size_m)

    @property
    def has_sizes(self) -> bool:
        """Whether the sizes of markers are known."""
        return self.marker_size_m > 0 or self.marker_table is not None


@dataclass(frozen=True)
class FrameOptions:
    """How the map's own frame is related to metres with z up.

    Args:
        scale: metres in a unit of the map; 1 if it is in metres.
        distance: instead, a measured distance: the names of two images, and the metres between their cameras. With
            photographs, marker:7 is the centre of marker 7.
        positions: instead, a CSV or JSON file of camera positions (image, x, y, z) in metres, z up.
        up: the direction up in the map: z, -y and the like, x,y,z, or level, as the cameras were held. By default z,
            unless the cameras are clearly not level.
    """

    scale: float | None = None
    distance: tuple[str, str, float] | None = None
    positions: Path | None = None
    up: str | None = None

    def __post_init__(self) -> None:
        sources = [value for value in (self.scale, self.distance, self.positions) if value is not None]
        three = self.distance is None or len(self.distance) == 3
        reject((not three, "a distance is two ends and the metres between", self.distance))
        distance_m = self.distance[2] if self.distance else 1.0
        reject(
            (len(sources) > 1, "the scale is given by one of scale, distance and positions", sources),
            (
                not 0 < (1.0 if self.scale is None else self.scale) < inf,
                "scale is a positive number of metres in a unit of the map",
                self.scale,
            ),
            (not 0 < distance_m < inf, "a distance is a positive number of metres", self.distance),
            (len(set(self.ends)) == 1, "a distance is between two different ends", self.distance),
            (not all(map(str.isdecimal, self.marker_ids)), "a marker's id is a number, as in marker:7", self.ends),
            (bool(self.up and self.positions), "positions give the direction up too: leave up out", self.up),
        )
        self.up_direction()

    @property
    def ends(self) -> tuple[str, ...]:
        """Ends of the distance, if there is one."""
        return self.distance[:2] if self.distance else ()

    @property
    def marker_ids(self) -> list[str]:
        """Ids of the ends that are markers."""
        return [end.removeprefix(MARKER) for end in self.ends if end.startswith(MARKER)]

    def frame_options(self) -> FrameOptions:
        """Return these options alone, checked, of a command that includes them."""
        return FrameOptions(**{field.name: getattr(self, field.name) for field in fields(FrameOptions)})

    def up_direction(self) -> tuple[float, ...] | None:
        """Return the given direction up in the map; None for "level" or none."""
        if self.up is None or self.up == "level":
            return None
        text = self.up if isinstance(self.up, str) else ",".join(map(str, self.up))  # in Python also numbers
        sign = -1.0 if text.startswith("-") else 1.0
        axis = text.lstrip("+-")
        try:
            if axis in ("x", "y", "z"):
                return tuple(sign * (axis == name) for name in "xyz")
            up = tuple(map(float, text.split(",")))
        except ValueError:
            up = ()
        if len(up) != 3 or not 0 < sum(map(abs, up)) < inf:
            fix = "Give z, -y and the like, three numbers x,y,z, or level."
            raise ConfigError("not a direction up", value=self.up, fix=fix)
        return up


@dataclass(frozen=True)
class SourceImages:
    """The images that a map is made from, and how its frame is related to metres with z up.

    Args:
        images: folder of the photographs, with any subfolders.
        max_side_px: photographs are reduced to this many pixels along their longer side; 0 keeps their size. The map's
            cameras and keypoints are those of the reduced photographs.
        scale: markers that give the scale.
        frame: how the map's frame is related to metres with z up.
        extractor: keypoints and descriptors; queries must use the same.
        keep_database: keep COLMAP's database of keypoints and matches, as `database.db`.
    """

    images: Path | None = None
    max_side_px: int = 1600
    scale: MarkerConfig = field(default_factory=MarkerConfig)
    frame: FrameOptions = no_option(FrameOptions())
    extractor: ExtractorConfig = no_option(ExtractorConfig())
    keep_database: bool = no_option(False)

    two_view_landmarks: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_range("max_side_px", self.max_side_px, 0)
        frame = self.frame
        has_scale = any((frame.scale, frame.distance, frame.positions))
        reject((self.scale.has_sizes and has_scale, "the scale is given twice: leave out marker sizes", None))

    def report(self) -> dict[str, Any]:
        """Settings as `report.json` has them."""
        settings = asdict(self)
        shared = {name: settings.pop(name) for name in ("frame", "extractor", "keep_database")}
        return {**shared, "photographs": settings}


@dataclass(frozen=True)
class PhotographsConfig(SourceImages):
    """How a folder of photographs is mapped.

    Args:
        camera_model: COLMAP's name of the camera model.
        camera_params: the camera model's parameters, for a photograph of full size, in COLMAP's order; they stay fixed.
            Without them, they are refined from the EXIF focal length, or from 1.2 times the longer side where there is
            none.
        shared_camera: whether photographs of one folder, size and EXIF focal length share their intrinsics.
        overlap: how many photographs that follow by name one is matched with, if they seem to be named in the order of
            capture; as many more at distances that double.
        max_reprojection_error_px: landmarks with a larger mean reprojection error are removed. Hand-held photographs do
            not reach the 0.5 px of rendered images.
        up_in_camera: the direction up in the camera frame, if it is the same for all. (x, y, z) with x right, y down, z
            forward: (0, 0, -1) for cameras that look straight down. By default cameras are held level, with any pitch.
    """

    camera_model: str = "SIMPLE_RADIAL"
    camera_params: tuple[float, ...] = ()
    shared_camera: bool = True
    overlap: int = no_option(10)
    max_reprojection_error_px: float = no_option(2.0)
    up_in_camera: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("overlap", self.overlap, 1)
        check_positive("max_reprojection_error_px", self.max_reprojection_error_px)
        if self.up_in_camera is not None and not 0 < sum(abs(value) for value in self.up_in_camera) < inf:
            raise ConfigError("up_in_camera must be a direction", value=self.up_in_camera)
        if given := self.frame.scale or self.frame.up:
            problem = "photographs have no unit or axes: give distance, positions or marker sizes, and up_in_camera"
            raise ConfigError(problem, value=given)

    def record(self) -> dict[str, Any]:
        """Settings and constants, from which the keys of finished maps are made."""
        scale = {**asdict(self.scale), "tolerance_percent": SCALE_TOLERANCE_PERCENT}
        settings = self.report()["photographs"]
        return {**settings, "scale": scale, "exhaustive_up_to": EXHAUSTIVE_UP_TO}


@dataclass(frozen=True)
class ImportConfig(SourceImages):
    """An existing COLMAP model with known poses, from which a map is made.

    With `images`, its landmarks are triangulated again at its poses, from keypoints of `extractor`.

    Args:
        model: folder of the model.
        database: the COLMAP database that the model was built from, or hloc's features in HDF5. Descriptors give the
            ambiguity of landmarks, and queries are matched with them.
        max_reprojection_error_px: landmarks with a larger mean reprojection error are removed; 0 keeps all, and with
            `images` means that of photographs.
    """

    model: Path = field(kw_only=True)
    database: Path | None = None
    max_reprojection_error_px: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("max_reprojection_error_px", self.max_reprojection_error_px, 0)

    @property
    def limit_px(self) -> float:
        """Landmarks with a larger mean reprojection error are removed; 0 keeps all."""
        of_images = PhotographsConfig.max_reprojection_error_px if self.images is not None else 0.0
        return self.max_reprojection_error_px or of_images

    def report(self) -> dict[str, Any]:
        """Settings as `report.json` has them."""
        report = super().report()
        own = ("model", "database", "max_reprojection_error_px")
        return {**report, "existing": {name: report["photographs"].pop(name) for name in own}}


def place_name(folder: Path) -> str:
    """Return the name of a place from the folder of its model or images: the last folder that has a name of its own."""
    generic = ["sparse", "model", "models", "sfm", "colmap", "map", "images", "image", "imgs", "rgb", "color", "input"]
    parts = [part for part in folder.resolve().parts[1:] if part not in generic and not part.isdigit()]
    return parts[-1] if parts else "model"


@dataclass(frozen=True)
class MapConfig:
    """How a mesh is mapped, by images rendered along a walk.

    Args:
        n_images: images rendered along the walk.
        extractor: keypoints and descriptors; queries must use the same.
        two_view_landmarks: whether two observations make a landmark. COLMAP's default is to ask for three, which gives
            a third as many landmarks, and fewer viewpoints that localize.
        max_reprojection_error_px: landmarks with a larger mean reprojection error are removed from the map (the
            paper's 0.5 px).
        camera: the mapping camera, if not the query camera, such as `{width: 1280, height: 720, fov_deg: 70}`.
        draw_camera: draw the mapping camera from the scene's seed, as `sample.cameras` draws query cameras.
        vary: draw from the scene's seed how it is photographed: on a walk through a part of it or all, with even spacing
            or turning on the spot, and with 8 to 100 % of `n_images`. From a few steps, baselines are narrow. Scans
            ignore it, with a warning. With "drift", poses and focal length are also estimated, as structure from motion
            does, in place of exact ones. Images are matched with at least 3 that follow, a number drawn from the scene's
            seed: baselines are narrow and poses drift where it is small. `draw_camera` then draws as `sample.any_lens`.
        appearance: highest strength, 0 to 1, of what a real camera and people in front of it do to mapping images; see
            `label.appearance`.
        keep_images: keep the rendered images, as `images/` in the map's folder.
        keep_database: keep COLMAP's database of keypoints and matches, as `database.db`.
    """

    n_images: int = 100
    extractor: ExtractorConfig = no_option(ExtractorConfig())
    two_view_landmarks: bool = no_option(True)
    max_reprojection_error_px: float = no_option(0.5)
    camera: CameraConfig | None = None
    draw_camera: bool = False
    vary: bool | Literal["drift"] = False
    appearance: float = 0.0
    keep_images: bool = False
    keep_database: bool = False

    def __post_init__(self) -> None:
        check_range("n_images", self.n_images, 2)
        if self.camera is not None and self.draw_camera:
            raise ConfigError("give camera or draw_camera, not both", value=self.camera)
        check_positive("max_reprojection_error_px", self.max_reprojection_error_px)
        check_range("mapping.appearance", self.appearance, 0, 1)

    @property
    def of_renders(self) -> list[str]:
        """Names of the options given that are for maps of renders only."""
        names = ("camera", "draw_camera", "vary", "appearance", "keep_images")
        return [f"mapping.{name}" for name in names if getattr(self, name)]

    def report(self) -> dict[str, Any]:
        """Settings as `report.json` has them."""
        return asdict(self)

    def record(self) -> dict[str, Any]:
        """Settings and constants, from which the keys of finished maps are made; without the mapping camera."""
        settings = asdict(self)
        del settings["camera"], settings["draw_camera"]
        for name in ("vary", "appearance"):  # maps made before these options existed keep their keys
            if not settings[name]:
                del settings[name]
        return {
            **settings,
            "walk": asdict(WALK),
            "extractor": self.extractor.record(),
            "partners": PARTNERS,
            "max_epipolar_error_px": MAX_EPIPOLAR_ERROR_PX,
            "min_triangulation_angle_deg": MIN_TRIANGULATION_ANGLE_DEG,
        }
