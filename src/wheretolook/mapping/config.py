"""Settings of the map stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from wheretolook.features.keypoints import ExtractorConfig
from wheretolook.mapping.photograph_config import PhotographsConfig
from wheretolook.mapping.walk import WalkConfig
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class MapConfig:
    """How a scene is mapped.

    Args:
        n_images: images rendered along the walk.
        walk: the walk and the camera's motion along it.
        extractor: keypoints and descriptors; queries must use the same.
        partners: images that each image is matched with, those that share most surface with it.
        max_epipolar_error_px: matches farther from the epipolar line of the known poses are dropped.
        min_triangulation_angle_deg: landmarks whose rays meet at less are not made.
        two_view_landmarks: whether two observations make a landmark. COLMAP's default is to ask for three, which gives
            a third as many, and fewer viewpoints that localize.
        max_reprojection_error_px: landmarks with a larger mean reprojection error are removed from the map (the
            paper's 0.5 px).
        photographs: a folder of photographs to map instead of a mesh; of the rest, only `extractor` and `keep_database`
            then count.
        keep_images: keep the rendered images, as `images/` in the map's folder.
        keep_database: keep COLMAP's database of keypoints and matches, as `database.db`.
    """

    n_images: int = 100
    walk: WalkConfig = field(default_factory=WalkConfig)
    extractor: ExtractorConfig = field(default_factory=ExtractorConfig)
    partners: int = 10
    max_epipolar_error_px: float = 2.0
    min_triangulation_angle_deg: float = 1.5
    two_view_landmarks: bool = True
    max_reprojection_error_px: float = 0.5
    photographs: PhotographsConfig = field(default_factory=PhotographsConfig)
    keep_images: bool = False
    keep_database: bool = False

    def __post_init__(self) -> None:
        if self.n_images < 2:
            raise ConfigError("a map needs at least two images", value=self.n_images)
        if self.partners < 1:
            raise ConfigError("partners must be at least 1", value=self.partners)
        for name in ("max_epipolar_error_px", "min_triangulation_angle_deg", "max_reprojection_error_px"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive", value=getattr(self, name))
