"""The occlusion models of a scene of a dataset, by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from wheretolook.dataset.folders import SceneFolder
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float
from wheretolook.mapping.cameras import colmap_poses
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import SceneError
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion, OcclusionModel
from wheretolook.visibility.tsdf import DepthImage, TsdfConfig, TsdfOcclusion, TsdfVolume


def scene_occlusion(
    scene: SceneFolder,
    camera: PinholeCamera,
    config: OcclusionConfig,
    device: str = "cpu",
    mesh: TexturedMesh | None = None,
    two_sided: bool = True,
    progress: bool = True,
) -> OcclusionModel:
    """Build the occlusion model that `config.model` names.

    Args:
        scene: its files; the mesh is needed for "mesh" and "tsdf" only, the map's images for "tsdf".
        camera: takes the depth images of "tsdf".
        config: which model, and its settings.
        device: where rays are cast and depth is rendered.
        mesh: the scene's mesh, if it is loaded already.
        two_sided: whether the backs of the mesh's triangles are surfaces; if not, locations inside solids are known.
        progress: show a progress bar for the fusion of depth images.

    Raises:
        SceneError: there is no mesh. MapError: there is no COLMAP model.
        ConfigError: the voxels do not fit into memory.
    """
    if config.model == "none":
        return NoOcclusion()
    if config.model == "hidden-points":
        return HiddenPointRemoval(config.radius, config.margin_m)
    if mesh is None:
        if not scene.mesh.is_file():
            raise SceneError(f"occlusion by {config.model} needs the scene's mesh", path=scene.mesh,
                             fix="Run the scenes stage, or use hidden-points or none.")  # fmt: skip
        mesh = load_mesh(scene.mesh)
    if config.model == "tsdf":
        volume, _ = scene_tsdf(scene, camera, config, mesh, device, progress)
        return TsdfOcclusion(volume, config.margin_m, device)
    return MeshOcclusion(MeshRaycaster(mesh, device), config.margin_m, two_sided)


def scene_tsdf(
    scene: SceneFolder, camera: PinholeCamera, config: OcclusionConfig, mesh: TexturedMesh, device: str = "cpu",
    progress: bool = True,
) -> tuple[TsdfVolume, RenderedDepth]:  # fmt: skip
    """Depth images of a scene, rendered where the map's images were taken, and the volume they fuse to.

    Raises:
        MapError: there is no COLMAP model. SceneError: no depth image has a reading.
        ConfigError: the voxels do not fit into memory.
    """
    images = RenderedDepth(WarpRenderer(mesh, device), camera, colmap_poses(scene.map))
    tsdf = TsdfConfig(voxel_size_m=config.voxel_m, max_depth_m=config.max_depth_m)
    return TsdfVolume.from_images(images, tsdf, progress), images


class RenderedDepth(Sequence[DepthImage]):
    """Depth images of poses (B, 3, 4), each rendered when it is asked for."""

    def __init__(self, renderer: WarpRenderer, camera: PinholeCamera, cam_from_world: Float) -> None:
        self.renderer, self.camera, self.cam_from_world = renderer, camera, cam_from_world

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @overload
    def __getitem__(self, index: int) -> DepthImage: ...
    @overload
    def __getitem__(self, index: slice) -> RenderedDepth: ...
    def __getitem__(self, index: int | slice) -> DepthImage | RenderedDepth:
        if isinstance(index, slice):
            return RenderedDepth(self.renderer, self.camera, self.cam_from_world[index])
        pose = self.cam_from_world[index]
        return DepthImage(self.renderer.render(self.camera, pose[None]).depth_m[0], self.camera, pose)
