"""Names and options of occlusion models; without the models, so that the command line reads them quickly."""

from __future__ import annotations

from dataclasses import dataclass, field

from wheretolook.utils.errors import ConfigError, check_positive, check_range, no_option


@dataclass(frozen=True)
class OcclusionKind:
    """What `Scene` needs to make an occlusion model."""

    model: str  # "module:class"; the class method `from_inputs` makes an instance
    needs: str = ""  # "mesh" or "depth images", if the landmarks are not enough
    settings: tuple[str, ...] = ()  # fields of `OcclusionConfig` that the model reads


OCCLUSION_MODELS = {
    "mesh": OcclusionKind("wheretolook.visibility.occlusion:MeshOcclusion", "mesh", ("margin_m",)),
    "tsdf": OcclusionKind(
        "wheretolook.visibility.occlusion:TsdfOcclusion", "depth images", ("margin_m", "voxel_m", "max_depth_m")
    ),
    "hidden-points": OcclusionKind(
        "wheretolook.visibility.hidden_points:HiddenPointRemoval", settings=("margin_m", "radius")
    ),
    "none": OcclusionKind("wheretolook.visibility.occlusion:NoOcclusion"),
}
"""Occlusion models by name, the most accurate first."""


@dataclass(frozen=True)
class OcclusionConfig:
    """Options of occlusion.

    Args:
        model: occlusion model: mesh, tsdf, hidden-points or none. "mesh" casts one ray for each landmark; "tsdf" does
            so against the surface that depth images fuse to, in a dataset rendered where the map's images were taken;
            "hidden-points" needs nothing but the landmarks; "none" sees through walls, as the paper's released code.
            With "tsdf", collisions of viewpoint maps and paths are with that surface too, not with the mesh, and what
            no depth image saw is not free.
        radius: radius of hidden-point removal, in distances of the farthest landmark. The default has the greatest mean
            F1 against the meshes of six mapped scenes; from 30 to 100 the mean stays within 0.01. Single scenes are
            best served by 5 to 100, mostly the larger the more open.
        voxel_m: voxel size of the TSDF.
        max_depth_m: range of the depth images.

    Attributes:
        margin_m: a surface this close in front of a landmark is the surface that the landmark is on: triangulated points are a few
            centimetres off it.
    """

    model: str = "mesh"
    margin_m: float = field(default=0.05, init=False)
    radius: float = no_option(50.0)
    voxel_m: float = no_option(0.02)
    max_depth_m: float = no_option(10.0)

    def __post_init__(self) -> None:
        check_occlusion_names((self.model,))
        check_range("occlusion.radius", self.radius, 1)
        check_positive("occlusion.voxel_m", self.voxel_m)
        check_positive("occlusion.max_depth_m", self.max_depth_m)

    def settings(self) -> dict[str, str | float]:
        """The model's name and the settings it reads; part of the keys of samples and labels."""
        return {"model": self.model, **{name: getattr(self, name) for name in OCCLUSION_MODELS[self.model].settings}}


def check_occlusion_names(names: tuple[str, ...]) -> None:
    """Raise ConfigError if an occlusion model is unknown or named twice."""
    if not {*names} <= {*OCCLUSION_MODELS} or len({*names}) < len(names):
        fix = f"There are {', '.join(OCCLUSION_MODELS)}."
        raise ConfigError("occlusion models must be known and named once", value=" ".join(names), fix=fix)
