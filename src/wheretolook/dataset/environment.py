"""A scene opened once, mesh or photographs: where a camera can be, what hides landmarks, what cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import NDArray

from wheretolook.dataset.layout import SceneFolder
from wheretolook.geometry.camera import Camera, cameras_by_id, only_camera
from wheretolook.geometry.lattices import ViewLattice, VoxelGrid
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.mapping.georeference import read_scale
from wheretolook.space.config import FreeSpaceConfig, MappedSpaceConfig
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import MapError, SceneError
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:
    from wheretolook.geometry.mesh import TexturedMesh
    from wheretolook.geometry.tsdf import DepthImage, TsdfVolume
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.mapping.landmarks import Landmarks
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.rendering.warp_renderer import WarpRenderer
    from wheretolook.space.free_space import FreeSpace
    from wheretolook.space.mapped_space import MappedSpace
    from wheretolook.visibility.occlusion import OcclusionModel


@dataclass(frozen=True)
class SceneConfig:
    """How a scene is looked at."""

    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)  # what hides landmarks
    free_space: FreeSpaceConfig = field(default_factory=FreeSpaceConfig)  # where a camera can be, by a mesh
    mapped_space: MappedSpaceConfig = field(default_factory=MappedSpaceConfig)  # and by photographs
    assume_metric: bool = False  # whether the unit of a map without a scale is taken for a metre


class Scene:
    """A scene of a dataset with the camera that will look. Each part is made when it is first asked for, and kept.

    The camera is that of the scene unless another one is given. `device` is where kernels run: "cpu", a CUDA device, or
    "auto" for the first GPU there is. A `mesh` (metres, z up) is given if there is no file of it. `progress` shows
    progress bars where depth images are fused.

    Raises (each part, when it is made):
        SceneError: the mesh is missing or cannot be used.
        MapError: the map is missing, damaged, or not in metres.
        ConfigError: there is no such device, or the voxels of a TSDF do not fit into memory.
    """

    def __init__(
        self,
        files: SceneFolder,
        camera: Camera | None = None,
        config: SceneConfig = SceneConfig(),
        device: str = "cpu",
        mesh: TexturedMesh | None = None,
        progress: bool = True,
    ) -> None:
        self.files = files
        self.camera = camera or files.camera
        self.config = config
        self.progress = progress
        self._device = device
        if mesh is not None:
            self.mesh = mesh

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.files.name

    @cached_property
    def device(self) -> str:
        """Where kernels run."""
        return usable_device(self._device)

    @cached_property
    def is_photographed(self) -> bool:
        """Whether the scene is known from photographs alone."""
        return self.files.is_photographed

    @property
    def source(self) -> Path:
        """The file that everything follows from: the mesh, or else the poses of the photographs."""
        return self.files.mapping_cameras if self.is_photographed else self.files.mesh

    @cached_property
    def mesh(self) -> TexturedMesh:
        """The textured mesh."""
        from wheretolook.scenes.loading import load_mesh

        return load_mesh(self.files.mesh)

    @cached_property
    def renderer(self) -> WarpRenderer:
        """Renders the mesh."""
        from wheretolook.rendering.warp_renderer import WarpRenderer

        return WarpRenderer(self.mesh, self.device)

    @property
    def raycaster(self) -> MeshRaycaster:
        """Casts rays against the mesh."""
        return self.mesh_space.raycaster

    @cached_property
    def mesh_space(self) -> FreeSpace:
        """Where a camera can be according to the mesh."""
        from wheretolook.space.free_space import FreeSpace

        return FreeSpace(self.mesh, self.config.free_space, self.device)

    @cached_property
    def mapped_space(self) -> MappedSpace:
        """Where a camera can be according to the photographs."""
        from wheretolook.space.mapped_space import MappedSpace

        self.require_metres()
        if self.mapping_poses is None:
            fix = "Run the map stage again."
            raise MapError("the poses of the map's photographs are missing", path=self.files.map, fix=fix)
        centers = camera_centers(self.mapping_poses.astype(np.float64))
        return MappedSpace(self.landmarks.points, centers, self.config.mapped_space)

    @cached_property
    def scanned_space(self) -> MappedSpace:
        """Where a camera can be according to a scan: near where the recording's was, clear of what it saw."""
        from wheretolook.mapping.colmap_model import colmap_poses
        from wheretolook.space.mapped_space import MappedSpace

        centers = camera_centers(colmap_poses(self.files.frames))
        return MappedSpace(self.mesh.vertices + self.mesh.origin, centers, self.config.mapped_space)

    @property
    def sampled_space(self) -> FreeSpace | MappedSpace:
        """Where viewpoints are sampled: the same for all occlusion models."""
        if self.is_photographed:
            return self.mapped_space
        return self.scanned_space if self.files.is_scanned else self.mesh_space

    @cached_property
    def space(self) -> FreeSpace | MappedSpace:
        """Where a camera can be: with occlusion by "tsdf" according to depth images, else as `sampled_space`."""
        if self.is_photographed or self.config.occlusion.model != "tsdf":
            return self.sampled_space
        from wheretolook.space.tsdf_space import TsdfSpace

        volume, images = self._fused
        return TsdfSpace(volume, images, self.config.free_space, self.device, self.progress)

    def require_metres(self) -> None:
        """Raise MapError if the map is not in metres, unless it is to be taken for one that is."""
        scale = read_scale(self.files.map)
        if scale is not None and not scale.is_metric and not self.config.assume_metric:
            fix = "Map it with marker sizes, a distance or positions (map.photographs.scale), or pass "
            fix += "--map.photographs.assume_metric true to take its unit for a metre."
            problem = "the map has no scale, and this needs metres"
            raise MapError(problem, path=self.files.map, value=scale.source, fix=fix)

    def free_voxels(self, views: ViewLattice, space: FreeSpace | MappedSpace) -> tuple[VoxelGrid, NDArray[np.int64]]:
        """The voxels of a lattice, and the ids of those where a camera can be, ascending.

        `space` is the scene's `space` or `sampled_space`. Raises SceneError if no voxel is free.
        """
        from wheretolook.dataset.sampling import free_locations

        grid = views.voxels(space.bounds)
        free = free_locations(grid, space)
        # depth images that have not seen all of the scene may put free space behind surfaces
        return grid, free[~self.occlusion.inside_geometry(grid.centers()[free])]

    @cached_property
    def landmarks(self) -> Landmarks:
        """The map's landmarks."""
        return self.files.read_landmarks()

    @cached_property
    def mapping_poses(self) -> Float | None:
        """Poses cam_from_world (M, 3, 4) of the mapping images, if they are known."""
        return self.files.mapping_poses()

    @property
    def occlusion_config(self) -> OcclusionConfig:
        """What hides landmarks: as asked for, or hidden-point removal where that needs a mesh and there is none."""
        config = self.config.occlusion
        needs_mesh = config.model in ("mesh", "tsdf")
        return replace(config, model="hidden-points") if needs_mesh and self.is_photographed else config

    @cached_property
    def occlusion(self) -> OcclusionModel:
        """Tells which landmarks are unoccluded from any location."""
        from wheretolook.visibility.hidden_points import HiddenPointRemoval
        from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion
        from wheretolook.visibility.tsdf import TsdfOcclusion

        config = self.occlusion_config
        if config.model == "none":
            return NoOcclusion()
        if config.model == "hidden-points":
            return HiddenPointRemoval(config.radius, config.margin_m)
        if "mesh" not in vars(self) and not self.files.mesh.is_file():
            fix = "Run the scenes stage, or use hidden-points or none."
            raise SceneError(f"occlusion by {config.model} needs the scene's mesh", path=self.files.mesh, fix=fix)
        if config.model == "tsdf":
            return TsdfOcclusion(self._fused[0], config.margin_m, self.device)
        return MeshOcclusion(self.raycaster, config.margin_m, self.mesh_space.two_sided)

    @cached_property
    def localization_map(self) -> LocalizationMap:
        """What a scorer is built from; answers for any location."""
        from wheretolook.inputs.localization_map import LocalizationMap

        return LocalizationMap(self.landmarks, self.camera, self.occlusion, self.device, self.mapping_poses)

    @cached_property
    def _fused(self) -> tuple[TsdfVolume, RenderedDepth]:
        """The volume that depth images fuse to, and these, rendered where the map's images were taken."""
        from wheretolook.geometry.tsdf import TsdfConfig, TsdfVolume
        from wheretolook.mapping.colmap_model import colmap_poses, read_model

        config = self.config.occlusion
        model = read_model(self.files.map)
        mapped = only_camera(cameras_by_id(model.cameras, self.files.map), self.files.map)
        images = RenderedDepth(self.renderer, mapped, colmap_poses(self.files.map, model))
        tsdf = TsdfConfig(voxel_size_m=config.voxel_m, max_depth_m=config.max_depth_m)
        return TsdfVolume.from_images(images, tsdf, self.progress), images


class RenderedDepth(Sequence["DepthImage"]):
    """Depth images of poses (B, 3, 4), each rendered when it is asked for."""

    def __init__(self, renderer: WarpRenderer, camera: Camera, cam_from_world: Float) -> None:
        self.renderer = renderer
        self.camera = camera
        self.cam_from_world = cam_from_world

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @overload
    def __getitem__(self, index: int) -> DepthImage: ...
    @overload
    def __getitem__(self, index: slice) -> RenderedDepth: ...
    def __getitem__(self, index: int | slice) -> DepthImage | RenderedDepth:
        if isinstance(index, slice):
            return RenderedDepth(self.renderer, self.camera, self.cam_from_world[index])
        from wheretolook.geometry.tsdf import DepthImage

        pose = self.cam_from_world[index]
        return DepthImage(self.renderer.render(self.camera, pose[None]).depth_m[0], self.camera, pose)
