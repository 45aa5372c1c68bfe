"""Where a camera can be in a scene, and what its landmarks are hidden by: from mesh, depth images or photographs."""

from __future__ import annotations

from wheretolook.config import Experiment
from wheretolook.dataset import SceneFolder
from wheretolook.geometry import PinholeCamera
from wheretolook.photograph_scenes import is_photographed, mapped_space
from wheretolook.scene_occlusion import scene_occlusion, scene_tsdf
from wheretolook.scenes.free_space import FreeSpace
from wheretolook.scenes.loading import load_mesh
from wheretolook.scenes.mapped_space import MappedSpace
from wheretolook.scenes.tsdf_space import TsdfSpace
from wheretolook.visibility import OcclusionModel
from wheretolook.visibility.config import OcclusionConfig
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
            (`wheretolook.photograph_scenes.occlusion_without_mesh`).
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
