"""Settings of maps made from photographs alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from pathlib import Path

from wheretolook.utils.errors import ConfigError


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
            sizes, fix = (self.marker_size_m, str(self.marker_table)), "Give marker_size_m or marker_table."
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
            raise ConfigError(
                "max_side_px must not be negative, overlap at least 1", value=(self.max_side_px, self.overlap)
            )
        if not self.max_reprojection_error_px > 0:
            raise ConfigError("max_reprojection_error_px must be positive", value=self.max_reprojection_error_px)
        if self.up_in_camera is not None and not 0 < sum(abs(value) for value in self.up_in_camera) < inf:
            raise ConfigError("up_in_camera must be a direction", value=self.up_in_camera)
