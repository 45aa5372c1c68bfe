"""Options of occlusion."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Literal, get_args

from wheretolook.utils.errors import ConfigError

DEFAULT_RADIUS = 50.0
"""Greatest mean F1 against the meshes of six mapped scenes (tests/benchmarks/bench_hidden_points.py). It is flat: from
30 to 100 the mean stays within 0.01. Single scenes are best served by 5 to 100, mostly the larger the more open."""

OcclusionName = Literal["mesh", "tsdf", "hidden-points", "none"]
OCCLUSION_NAMES: tuple[str, ...] = get_args(OcclusionName)


@dataclass(frozen=True)
class OcclusionConfig:
    """Options of occlusion.

    Args:
        model: how occlusion is found: mesh, tsdf, hidden-points or none. "mesh" casts one ray for each landmark; "tsdf"
            does so against the surface that depth images fuse to, here rendered where the map's images were taken;
            "hidden-points" needs nothing but the landmarks; "none" sees through walls, as the paper's released code.
            With "tsdf", collisions of viewpoint maps and paths are with that surface too, not with the mesh, and what
            no depth image saw is not free.
        radius: radius of hidden-point removal, in distances of the farthest landmark.
        voxel_m: voxel size of the TSDF.
        max_depth_m: range of the depth images.

    Attributes:
        margin_m: a surface this close in front of a landmark is the landmark's own: triangulated points
            lie a few centimetres off it.
    """

    model: OcclusionName = "mesh"
    margin_m: float = field(default=0.05, init=False)
    radius: float = DEFAULT_RADIUS
    voxel_m: float = 0.02
    max_depth_m: float = 10.0

    def __post_init__(self) -> None:
        check_occlusion_names((self.model,))
        if not 1 <= self.radius < inf:
            raise ConfigError("occlusion.radius must be at least 1", value=self.radius)
        for name in ("voxel_m", "max_depth_m"):
            if not 0 < getattr(self, name) < inf:
                raise ConfigError(f"occlusion.{name} must be positive", value=getattr(self, name))

    def settings(self) -> dict[str, str | float]:
        """The model and the settings it reads."""
        names = {"mesh": "margin_m", "tsdf": "margin_m voxel_m max_depth_m", "hidden-points": "margin_m radius"}
        return {"model": self.model, **{name: getattr(self, name) for name in names.get(self.model, "").split()}}


def check_occlusion_names(names: tuple[str, ...]) -> None:
    """Raise ConfigError if an occlusion model is unknown or named twice."""
    unknown = [name for name in names if name not in OCCLUSION_NAMES]
    if unknown or len(set(names)) < len(names):
        fix = f"There are {', '.join(OCCLUSION_NAMES)}."
        raise ConfigError("occlusion models must be known and named once", value=" ".join(names), fix=fix)
