"""Settings of the map stage, for rendered images and for photographs."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from pathlib import Path

from wheretolook.features.config import ExtractorConfig
from wheretolook.geometry.camera import CameraConfig
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class WalkConfig:
    """How a person with a camera walks through a scene.

    Args:
        coverage: share of the reachable floor that gets visited; the walk ends there.
        image_spacing_m: largest distance along the walk between two images. Images farther apart overlap too little.
        eye_height_m: mean height of the camera above the floor in metres.
        swing_deg: how far the camera swings to either side of the walk.
        pitch_deg: mean pitch, negative is down.

    Attributes:
        visit_radius_m: floor within this walking distance of the walk counts as visited. Only a start: it grows until
            the walk is short enough for the images to be `image_spacing_m` apart.
        eye_height_variation_m: largest deviation of the camera's height, as of one held in a hand.
        cell_m: distance between neighbouring places of the grid that the walk runs on, well below a door's width.
        max_step_height_m: largest change of the floor's height from one place to the next: two steps of stairs.
        swing_period: number of images in one swing from left to right and back, so that neighbours overlap.
        pitch_variation_deg: largest deviation of the pitch, as of a camera held in a hand.
    """

    coverage: float = 0.7
    visit_radius_m: float = field(default=1.0, init=False)
    image_spacing_m: float = 0.6
    eye_height_m: float = 1.45
    eye_height_variation_m: float = field(default=0.2, init=False)
    cell_m: float = field(default=0.3, init=False)
    max_step_height_m: float = field(default=0.4, init=False)
    swing_deg: float = 40.0
    swing_period: float = field(default=12.0, init=False)
    pitch_deg: float = -5.0
    pitch_variation_deg: float = field(default=10.0, init=False)

    def __post_init__(self) -> None:
        if not 0 < self.coverage <= 1:
            raise ConfigError("coverage must be in (0, 1]", value=self.coverage)
        for name in ("image_spacing_m", "eye_height_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", value=getattr(self, name))
        variation_m = self.eye_height_variation_m
        if not 0 <= variation_m < self.eye_height_m:
            raise ConfigError("eye_height_variation_m must be at least 0 and below eye_height_m", value=variation_m)
        if not abs(self.pitch_deg) + abs(self.pitch_variation_deg) < 90:
            raise ConfigError("the pitch must stay within 90 degrees", value=(self.pitch_deg, self.pitch_variation_deg))


@dataclass(frozen=True)
class KnownDistance:
    """A distance measured by hand.

    Args:
        first: name of a photograph, for where it was taken from, or "marker:<id>", for a marker's centre.
        second: the other end, the same way.
        distance_m: between the two, in metres.
    """

    first: str
    second: str
    distance_m: float

    def __post_init__(self) -> None:
        if not 0 < self.distance_m < inf or self.first == self.second:
            value = (self.first, self.second, self.distance_m)
            raise ConfigError("a known distance is a positive number of metres between two places", value=value)

    @property
    def marker_ids(self) -> tuple[int, ...]:
        """Ids of the ends that are markers. Raises ConfigError if an id is not a number."""
        names = [end.removeprefix("marker:") for end in (self.first, self.second) if end.startswith("marker:")]
        if not all(name.isdecimal() for name in names):
            raise ConfigError("a marker's id is a number", value=(self.first, self.second), fix="Write marker:7.")
        return tuple(map(int, names))


@dataclass(frozen=True)
class ScaleConfig:
    """Where the scale of a map from photographs comes from: markers, a distance, or positions; or nowhere.

    Args:
        dictionary: dictionary of the markers, by OpenCV's name. DICT_4X4_50, DICT_APRILTAG_36H11, DICT_ARUCO_ORIGINAL
            and so on.
        marker_size_m: side of the black square of every marker, in metres; 0 for no markers.
        marker_table: CSV file of markers of different sizes, with the columns `id` and `size_m`. Other markers are
            passed over.
        distance: one known distance, between photographs or markers.
        positions: CSV or JSON file of where photographs were taken. CSV with the columns `image`, `x`, `y`, `z`, or
            JSON `{"image": [x, y, z]}`, in metres, z up. They fix the whole frame, not only its scale.

    Attributes:
        tolerance_percent: a marker's side that differs by more from its size is refused, and a position that is off by
            more of the extent of all positions: a wrong size or name is off by more, a good measurement by less.
    """

    dictionary: str = "DICT_4X4_50"
    marker_size_m: float = 0.0
    marker_table: Path | None = None
    tolerance_percent: float = field(default=5.0, init=False)
    distance: KnownDistance | None = None
    positions: Path | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.marker_size_m < inf:
            raise ConfigError("marker_size_m must not be negative", value=self.marker_size_m)
        if self.marker_size_m > 0 and self.marker_table is not None:
            sizes = (self.marker_size_m, str(self.marker_table))
            fix = "Give marker_size_m or marker_table."
            raise ConfigError("markers have one size, or a table of sizes", value=sizes, fix=fix)
        if self.has_marker_sizes + (self.distance is not None) + (self.positions is not None) > 1:
            value = "markers, a distance, positions: more than one was given"
            fix = "Give marker sizes, a distance or positions."
            raise ConfigError("the scale comes from one source", value=value, fix=fix)

    @property
    def has_marker_sizes(self) -> bool:
        """Whether markers of known size give the scale."""
        return self.marker_size_m > 0 or self.marker_table is not None


@dataclass(frozen=True)
class PhotographsConfig:
    """How a folder of photographs is mapped. Without one, maps are made of rendered images.

    Args:
        images: folder of the photographs, with any folders in it.
        name: name of the scene; the folder's own if empty.
        max_side_px: photographs are reduced to this many pixels along their longer side; 0 keeps their size. The map's
            cameras and keypoints are those of the reduced photographs.
        camera_model: COLMAP's name of the camera model.
        camera_params: the camera model's parameters, for a photograph of full size. In COLMAP's order, kept as given.
            Without them, they are refined from the EXIF focal length, or from 1.2 times the longer side where there is
            none.
        shared_camera: whether photographs of one folder, size and EXIF focal length share their intrinsics.
        overlap: how many photographs that follow by name one is matched with; as many more at distances that double.
        max_reprojection_error_px: landmarks with a larger mean reprojection error are removed. Photographs taken by
            hand do not reach the 0.5 px of rendered images.
        up_in_camera: where up is as a camera sees it, if it is the same for all. (x, y, z) with x right, y down, z
            forward: (0, 0, -1) for cameras that look straight down. By default cameras are held level, with any pitch.
        scale: where the scale comes from.
        assume_metric: take a map without a scale for one in metres, where metres are needed.

    Attributes:
        exhaustive_up_to: every pair of photographs is matched up to this number of them, in minutes. Of more, each is
            matched with those that follow it by name.
    """

    images: Path | None = None
    name: str = ""
    max_side_px: int = 1600
    camera_model: str = "SIMPLE_RADIAL"
    camera_params: tuple[float, ...] = ()
    shared_camera: bool = True
    exhaustive_up_to: int = field(default=60, init=False)
    overlap: int = 10
    max_reprojection_error_px: float = 2.0
    up_in_camera: tuple[float, float, float] | None = None
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    assume_metric: bool = False

    def __post_init__(self) -> None:
        if self.max_side_px < 0 or self.overlap < 1:
            value = (self.max_side_px, self.overlap)
            raise ConfigError("max_side_px must not be negative, overlap at least 1", value=value)
        if not self.max_reprojection_error_px > 0:
            raise ConfigError("max_reprojection_error_px must be positive", value=self.max_reprojection_error_px)
        if self.up_in_camera is not None and not 0 < sum(abs(value) for value in self.up_in_camera) < inf:
            raise ConfigError("up_in_camera must be a direction", value=self.up_in_camera)


@dataclass(frozen=True)
class ExistingModelConfig:
    """A COLMAP model of one's own, of known poses, from which a scene is made instead of from a mesh or photographs.

    Its world is taken to be in metres, z up; `photographs.scale` and `level` make it so. With `photographs.images`, the
    folder of its images, its landmarks are triangulated anew at its poses, from keypoints of `extractor`.

    Args:
        model: folder of the model.
        name: name of the scene; the folder's own if empty. For sparse/0 and the like that of the folder above.
        database: the COLMAP database that the model was built from, or hloc's features in HDF5. Descriptors tell how
            easily landmarks are mistaken for one another, and queries are matched with them.
        mesh: textured mesh of the scene in the model's frame, for free space, occlusion and labels. Without one, free
            space is where `scenes.mapped_space` says, and hidden-point removal tells what is occluded.
        mesh_up: which axis of the mesh's file is the model's z: x, y or z, with a minus sign if it points down.
        camera_id: the camera of the model that will look, where it has several and `camera` names none.
        level: turn the model upright by how its cameras were held.
        max_reprojection_error_px: landmarks with a larger mean reprojection error are removed; 0 for all that the
            model's own mapper kept.
    """

    model: Path | None = None
    name: str = ""
    database: Path | None = None
    mesh: Path | None = None
    mesh_up: str = "z"
    camera_id: int | None = None
    level: bool = False
    max_reprojection_error_px: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.max_reprojection_error_px < inf:
            value = self.max_reprojection_error_px
            raise ConfigError("existing.max_reprojection_error_px must not be negative", value=value)

    @property
    def scene_name(self) -> str:
        """Name of the scene's folder."""
        assert self.model is not None
        parts = [part for part in self.model.resolve().parts[1:] if part not in _NO_NAMES and not part.isdigit()]
        return self.name or (parts[-1] if parts else "model")


_NO_NAMES = ("sparse", "model", "models", "sfm", "colmap", "map")  # folders of models whose names say nothing


@dataclass(frozen=True)
class MapConfig:
    """How a scene is mapped.

    Args:
        n_images: images rendered along the walk.
        walk: the walk and the camera's motion along it.
        extractor: keypoints and descriptors; queries must use the same.
        two_view_landmarks: whether two observations make a landmark. COLMAP's default is to ask for three, which gives
            a third as many landmarks, and fewer viewpoints that localize.
        max_reprojection_error_px: landmarks with a larger mean reprojection error are removed from the map (the
            paper's 0.5 px).
        photographs: a folder of photographs to map instead of a mesh; of the other settings, only `extractor` and
            `keep_database` then count.
        existing: a model of one's own to take instead; then only `extractor`, `keep_database` and `photographs.images`
            and `.scale` count besides.
        camera: the camera that maps, if not the one that looks, such as `{width: 1280, height: 720, fov_deg: 70}`.
        draw_camera: draw the camera that maps from the scene's seed, as `sample.cameras` draws those that look.
        keep_images: keep the rendered images, as `images/` in the map's folder.
        keep_database: keep COLMAP's database of keypoints and matches, as `database.db`.

    Attributes:
        partners: images that each image is matched with, those that share most surface with it; time grows with
            their number.
        max_epipolar_error_px: matches farther from the epipolar line of the known poses are dropped. Keypoints are
            found to within a pixel in each image.
        min_triangulation_angle_deg: landmarks whose rays meet at less are not made: COLMAP's own limit.
    """

    n_images: int = 100
    walk: WalkConfig = field(default_factory=WalkConfig)
    extractor: ExtractorConfig = field(default_factory=ExtractorConfig)
    partners: int = field(default=10, init=False)
    max_epipolar_error_px: float = field(default=2.0, init=False)
    min_triangulation_angle_deg: float = field(default=1.5, init=False)
    two_view_landmarks: bool = True
    max_reprojection_error_px: float = 0.5
    photographs: PhotographsConfig = field(default_factory=PhotographsConfig)
    existing: ExistingModelConfig = field(default_factory=ExistingModelConfig)
    camera: CameraConfig | None = None
    draw_camera: bool = False
    keep_images: bool = False
    keep_database: bool = False

    def __post_init__(self) -> None:
        if self.n_images < 2:
            raise ConfigError("a map needs at least two images", value=self.n_images)
        if self.camera is not None and self.draw_camera:
            raise ConfigError("the camera that maps is given and to be drawn", value=self.camera, fix="Choose one.")
        if not self.max_reprojection_error_px > 0:
            raise ConfigError("max_reprojection_error_px must be positive", value=self.max_reprojection_error_px)
