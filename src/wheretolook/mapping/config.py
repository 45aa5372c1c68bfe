"""Settings of the map stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from wheretolook.features.keypoints import ExtractorConfig
from wheretolook.mapping.photograph_config import PhotographsConfig
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
        if not 0 <= self.eye_height_variation_m < self.eye_height_m:
            raise ConfigError(
                "eye_height_variation_m must be at least 0 and below eye_height_m", value=self.eye_height_variation_m
            )
        if not abs(self.pitch_deg) + abs(self.pitch_variation_deg) < 90:
            raise ConfigError("the pitch must stay within 90 degrees", value=(self.pitch_deg, self.pitch_variation_deg))


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
    keep_images: bool = False
    keep_database: bool = False

    def __post_init__(self) -> None:
        if self.n_images < 2:
            raise ConfigError("a map needs at least two images", value=self.n_images)
        if not self.max_reprojection_error_px > 0:
            raise ConfigError("max_reprojection_error_px must be positive", value=self.max_reprojection_error_px)
