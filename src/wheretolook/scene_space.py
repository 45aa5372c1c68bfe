"""Where a camera can be in a scene, and what its landmarks are hidden by: from its mesh, or else from photographs."""

from __future__ import annotations

from wheretolook.config import Experiment
from wheretolook.dataset import SceneFolder
from wheretolook.geometry import PinholeCamera
from wheretolook.photograph_scenes import is_photographed, mapped_space
from wheretolook.scene_occlusion import scene_occlusion
from wheretolook.scenes.free_space import FreeSpace
from wheretolook.scenes.loading import load_mesh
from wheretolook.scenes.mapped_space import MappedSpace
from wheretolook.visibility import OcclusionModel
from wheretolook.visibility.config import OcclusionConfig


def space_and_occlusion(
    scene: SceneFolder, camera: PinholeCamera, experiment: Experiment, occlusion: OcclusionConfig
) -> tuple[FreeSpace | MappedSpace, OcclusionModel]:
    """Free space of a scene, by its mesh or else its mapping cameras, and which landmarks its locations see.

    Args:
        scene: its files.
        camera: takes the depth images of a TSDF.
        experiment: settings of free space, and the device.
        occlusion: model asked for; without a mesh, one that needs none
            (`wheretolook.photograph_scenes.occlusion_without_mesh`).

    Raises:
        SceneError: the mesh is missing or cannot be used. MapError: there is no map, or one without a scale.
    """
    device = experiment.warp_device
    if is_photographed(scene):
        space = mapped_space(scene, experiment.scenes.mapped_space, experiment.map.photographs.assume_metric)
        return space, scene_occlusion(scene, camera, occlusion, device)
    mesh = load_mesh(scene.mesh)
    free_space = FreeSpace(mesh, experiment.scenes.free_space, device)
    return free_space, scene_occlusion(scene, camera, occlusion, device, mesh, free_space.two_sided)
