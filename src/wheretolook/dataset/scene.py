"""Where a camera can be in a scene, and what its landmarks are hidden by: from mesh, depth images or photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wheretolook.config import Experiment
from wheretolook.dataset.folders import SceneFolder
from wheretolook.dataset.scene_occlusion import scene_occlusion, scene_tsdf
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.scale import read_scale
from wheretolook.scenes.loading import load_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.mapped_space import MappedSpace, MappedSpaceConfig
from wheretolook.space.tsdf_space import TsdfSpace
from wheretolook.utils.errors import MapError
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.occlusion import OcclusionModel
from wheretolook.visibility.tsdf import TsdfOcclusion


def space_and_occlusion(
    scene: SceneFolder, camera: PinholeCamera, experiment: Experiment, occlusion: OcclusionConfig,
    free_by_tsdf: bool = True,
) -> tuple[FreeSpace | MappedSpace, OcclusionModel]:  # fmt: skip
    """Free space of a scene, by its mesh or else its mapping cameras, and which landmarks its locations see.

    With the occlusion model "tsdf", free space is by the same fused depth images (`TsdfSpace`, a `FreeSpace`), as of a
    robot that has no mesh.

    Args:
        scene: its files.
        camera: takes the depth images of a TSDF.
        experiment: settings of free space, and the device.
        occlusion: model asked for; without a mesh, one that needs none
            (`wheretolook.dataset.scene.occlusion_without_mesh`).
        free_by_tsdf: False keeps free space by the mesh whatever hides landmarks, so that all occlusion models are
            sampled at the same locations.

    Raises:
        SceneError: the mesh is missing or cannot be used. MapError: there is no map, or one without a scale.
    """
    device = experiment.warp_device
    if is_photographed(scene):
        space = mapped_space(scene, experiment.scenes.mapped_space, experiment.map.photographs.assume_metric)
        return space, scene_occlusion(scene, camera, occlusion, device)
    mesh = load_mesh(scene.mesh)
    if occlusion.model == "tsdf" and free_by_tsdf:
        volume, images = scene_tsdf(scene, camera, occlusion, mesh, device)
        tsdf_space = TsdfSpace(volume, images, experiment.scenes.free_space, device)
        return tsdf_space, TsdfOcclusion(volume, occlusion.margin_m, device)
    free_space = FreeSpace(mesh, experiment.scenes.free_space, device)
    return free_space, scene_occlusion(scene, camera, occlusion, device, mesh, free_space.two_sided)


def is_photographed(scene: SceneFolder) -> bool:
    """Whether a scene is known from photographs alone.

    Raises:
        MapError: it has no mesh, and its map's report is damaged.
    """
    return not scene.mesh.is_file() and read_scale(scene.map) is not None


def mapped_space(scene: SceneFolder, config: MappedSpaceConfig, assume_metric: bool) -> MappedSpace:
    """Free space of a scene of photographs.

    Raises:
        MapError: the map has no scale, and is not to be taken for one in metres.
    """
    require_metres(scene, assume_metric)
    poses = scene.mapping_poses()
    if poses is None:
        raise MapError("the poses of the map's photographs are missing", path=scene.map, fix="Run the map stage again.")
    return MappedSpace(Landmarks.load(scene.landmarks).points, camera_centers(poses.astype(np.float64)), config)


def require_metres(scene: SceneFolder, assume_metric: bool) -> None:
    """Raise MapError if a scene's map is not in metres, unless it is to be taken for one that is."""
    scale = read_scale(scene.map)
    if scale is not None and not scale.is_metric and not assume_metric:
        raise MapError(
            "the map has no scale, and this needs metres", path=scene.map, value=scale.source,
            fix="Map it with marker sizes, a distance or positions (map.photographs.scale), or pass "
            "--map.photographs.assume_metric true to take its unit for a metre.",
        )  # fmt: skip


def occlusion_without_mesh(config: OcclusionConfig) -> OcclusionConfig:
    """The occlusion model asked for, or hidden-point removal if that one needs a mesh."""
    return replace(config, model="hidden-points") if config.model in ("mesh", "tsdf") else config
