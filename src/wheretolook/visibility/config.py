"""Options of occlusion."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal, get_args

from wheretolook.utils.errors import ConfigError
from wheretolook.visibility.hidden_points import DEFAULT_RADIUS

OcclusionName = Literal["mesh", "tsdf", "hidden-points", "none"]
OCCLUSION_NAMES: tuple[str, ...] = get_args(OcclusionName)


@dataclass(frozen=True)
class OcclusionConfig:
    """Options of occlusion.

    Args:
        model: "mesh" casts one ray for each landmark; "tsdf" does so against the surface that depth images fuse to,
            here rendered where the map's images were taken; "hidden-points" needs nothing but the landmarks; "none"
            sees through walls, as the paper's released code. With "tsdf", collisions of viewpoint maps and paths are
            with that surface too, not with the mesh, and what no depth image saw is not free.
        margin_m: a surface this close in front of a landmark is the landmark's own.
        radius: of hidden-point removal, in distances of the farthest landmark.
        voxel_m: voxel size of the TSDF.
        max_depth_m: range of the depth images.
    """

    model: OcclusionName = "mesh"
    margin_m: float = 0.05
    radius: float = DEFAULT_RADIUS
    voxel_m: float = 0.02
    max_depth_m: float = 10.0

    def __post_init__(self) -> None:
        check_occlusion_names((self.model,))
        if not 0 <= self.margin_m < inf:
            raise ConfigError("occlusion.margin_m must not be negative", value=self.margin_m)
        if not 1 <= self.radius < inf:
            raise ConfigError("occlusion.radius must be at least 1", value=self.radius)
        for name in ("voxel_m", "max_depth_m"):
            if not 0 < getattr(self, name) < inf:
                raise ConfigError(f"occlusion.{name} must be positive", value=getattr(self, name))

    def settings(self) -> dict[str, str | float]:
        """The model and those settings that it reads."""
        read = {"mesh": ["margin_m"], "tsdf": ["margin_m", "voxel_m", "max_depth_m"],
                "hidden-points": ["margin_m", "radius"], "none": []}  # fmt: skip
        return {"model": self.model, **{name: getattr(self, name) for name in read[self.model]}}


def check_occlusion_names(names: tuple[str, ...]) -> None:
    """Raise ConfigError if an occlusion model is unknown or named twice."""
    unknown = [name for name in names if name not in OCCLUSION_NAMES]
    if unknown or len(set(names)) < len(names):
        raise ConfigError(
            "occlusion models must be known and named once", value=" ".join(names),
            fix=f"There are {', '.join(OCCLUSION_NAMES)}.",
        )  # fmt: skip
