"""What counts as free space: options only, so that the command line reads them quickly."""

from __future__ import annotations

from dataclasses import dataclass, field

from wheretolook.utils.errors import check_positive, check_range


@dataclass(frozen=True)
class FreeSpaceConfig:
    """What counts as free.

    Args:
        clearance_m: least distance of a camera to any geometry.
        max_floor_drop_m: greatest height above the surface straight below, which must be roughly level.
        two_sided: whether triangles are surfaces from both sides. If not, only fronts count as floor and as enclosure,
            so that a point inside a solid or outside a shell of one layer is never free. If not given, triangles are
            taken as one-sided if most points that would be free in a two-sided scene see mostly fronts.

    Attributes:
        min_enclosure: least share of 34 rays around a point (16 level, 8 rising and 8 falling by 45 degrees, up and
            down) that meet a surface. A point in a room without a ceiling reaches 25 / 34 = 0.74; one outside a wall or
            above a ceiling stays below 19 / 34 = 0.56, since at least half of its level rays and all rising ones leave
            the scene. Windows, doors and holes of a scan let some rays out.
        min_sight_m: in a two-sided scene, where the inside of closed furniture looks like a room, at least a quarter of
            the level rays must be this long; 1 m leaves corridors of 0.8 m free and closets of 0.7 m not.
    """

    clearance_m: float = 0.25
    max_floor_drop_m: float = 4.0
    min_enclosure: float = field(default=0.6, init=False)
    two_sided: bool | None = None
    min_sight_m: float = field(default=1.0, init=False)

    def __post_init__(self) -> None:
        check_positive("clearance_m", self.clearance_m)
        check_positive("max_floor_drop_m", self.max_floor_drop_m)


@dataclass(frozen=True)
class MappedSpaceConfig:
    """What counts as free without a mesh: landmarks do not show free space, but positions of mapping cameras do.

    Args:
        max_camera_distance_m: greatest distance to the nearest position of a mapping camera.
        clearance_m: least distance to any landmark.
    """

    max_camera_distance_m: float = 0.75
    clearance_m: float = 0.25

    def __post_init__(self) -> None:
        check_positive("max_camera_distance_m", self.max_camera_distance_m)
        check_range("clearance_m", self.clearance_m, 0)
