"""Map, camera, occlusion, free space and renderer of a place, each made once when it is first used."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.dataset.layout import SceneFolder
from wheretolook.geometry.camera import Camera, cameras_by_id, only_camera
from wheretolook.geometry.lattices import ViewLattice, VoxelGrid
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.tsdf import DepthImage, DepthImages, TsdfVolume
from wheretolook.mapping.colmap_model import colmap_poses, read_model
from wheretolook.mapping.config import FrameOptions, place_name
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map, find_mesh
from wheretolook.mapping.map_frame import MapFrame, warn_of_mesh
from wheretolook.space.config import FreeSpaceConfig, MappedSpaceConfig
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError, check_positive
from wheretolook.utils.texts import LOG
from wheretolook.visibility.config import OCCLUSION_MODELS, OcclusionConfig, check_occlusion_names

if TYPE_CHECKING:  # pandas, torch and Warp are imported when first needed
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.rendering.warp_renderer import Renderer
    from wheretolook.space.free_space import FreeSpace
    from wheretolook.space.mapped_space import MappedSpace
    from wheretolook.visibility.occlusion import OcclusionModel


@dataclass(frozen=True)
class ColmapFiles:
    """A COLMAP model, and files in its frame.

    Raises ConfigError if both a mesh and depth images are given, or the largest reprojection error is not positive.
    """

    model: Path
    mesh: Path | None = None
    depth: Path | None = None  # folder of depth images, see `wheretolook.mapping.depth_images.read_depth_images`
    depth_scale: float = 1000.0  # units of integer depth images in a metre
    database: Path | None = None  # COLMAP database or hloc features, for the landmarks' ambiguity
    max_reprojection_error_px: float | None = None  # landmarks with a larger mean error are dropped
    frame: FrameOptions = FrameOptions()  # how its frame is related to the world
    mesh_up: str = "z"  # axis of the mesh's file that is the model's z

    def __post_init__(self) -> None:
        if self.mesh is not None and self.depth is not None:
            raise ConfigError("give a mesh or depth images, not both", value=str(self.depth))
        if self.max_reprojection_error_px is not None:
            check_positive("the largest reprojection error", self.max_reprojection_error_px)

    @property
    def name(self) -> str:
        """Name of the place."""
        return place_name(self.model)

    def open_map(self, device: str) -> Map:
        """Open the map; a device computes the ambiguity of its landmarks."""
        scale = None
        if self.depth is not None:
            from wheretolook.mapping.depth_images import metres_per_unit

            scale = metres_per_unit(self.model, self.depth, self.depth_scale)
        return Map.open(self.model, self.database, self.frame, self.max_reprojection_error_px, device, scale)


class Scene:
    """A map with its camera, occlusion models, free space and renderer; world in metres, z up.

    `files` are a scene of a dataset, known from a mesh or from photographs, or a COLMAP model, known from its landmarks
    and optionally a mesh or depth images. `camera` of the views takes the place of a dataset's camera; of a COLMAP
    model it is a camera or a camera_id, None for the only one. `device` runs the kernels: "cpu", a CUDA device, or
    "auto" for the first GPU. `free_space` is that of a mesh or depth images, `mapped_space` that of photographs alone.
    `progress` shows bars where depth images are fused. With `cache_bytes` of memory, lines of sight that are asked for
    again are not computed again. A mesh (metres, z up) or renderer that is assigned takes the place of that in the files.

    Raises (when a part is first used):
        SceneError: the mesh or the depth images are missing or cannot be used.
        MapError: the map is missing, damaged, or not in metres.
        ConfigError: unknown device or occlusion model, or the voxels of a TSDF exceed the memory.
    """

    def __init__(
        self,
        files: SceneFolder | ColmapFiles,
        camera: Camera | int | None = None,
        occlusion_config: OcclusionConfig = OcclusionConfig(),
        free_space: FreeSpaceConfig = FreeSpaceConfig(),
        mapped_space: MappedSpaceConfig = MappedSpaceConfig(),
        device: str = "cpu",
        progress: bool = True,
        cache_bytes: int = 0,
    ) -> None:
        self.files = files
        self.name = files.name
        self.given_occlusion = occlusion_config
        self.free_space = free_space
        self.mapped_space_config = mapped_space
        self.progress = progress
        self.cache_bytes = cache_bytes
        self._camera = camera
        self._device = device
        self._occlusion_models: dict[str, OcclusionModel] = {}

    @classmethod
    def of_colmap(
        cls,
        files: ColmapFiles,
        camera: Camera | int | None = None,
        occlusion_name: str | None = None,
        device: str = "cpu",
        cache_bytes: int = 0,
    ) -> Scene:
        """Make the scene of a COLMAP model, with an occlusion model by name, or the most accurate one available.

        Raises ConfigError if the occlusion model is unknown or its files are missing.
        """
        scene = cls(files, camera, device=device, cache_bytes=cache_bytes)
        name = occlusion_name or scene.available_occlusion[0]
        if occlusion_name is None and files.mesh is None and files.depth is None and (mesh := find_mesh(files.model)):
            LOG.info("mesh not used: %s; --mesh gives occlusion by it, if it is in the map's frame", mesh)
        scene.check_occlusion(name)
        scene.given_occlusion = OcclusionConfig(name)
        return scene

    @property
    def folder(self) -> SceneFolder:
        """The files of a scene of a dataset."""
        assert isinstance(self.files, SceneFolder)
        return self.files

    @cached_property
    def device(self) -> str:
        """The device that runs kernels, such as "cpu" or "cuda:0"."""
        return usable_device(self._device)

    # Map and camera

    @cached_property
    def map(self) -> Map:
        """The map; of a scene of a dataset without the observations of its photographs, see `Map.with_images`."""
        return self.files.open_map(self.device)

    @property
    def landmarks(self) -> Landmarks:
        """The map's landmarks."""
        return self.map.landmarks

    @property
    def frame(self) -> MapFrame:
        """The frame that users give and get coordinates in."""
        return self.map.frame

    @cached_property
    def camera(self) -> Camera:
        """The camera of the views."""
        if self._camera is None and isinstance(self.files, SceneFolder):
            return self.files.camera
        return self._camera if isinstance(self._camera, Camera) else self.map.camera(self._camera)

    @cached_property
    def localization_map(self) -> LocalizationMap:
        """The input of scorers, with `occlusion`."""
        return self.with_occlusion(self.occlusion)

    def with_occlusion(self, occlusion: OcclusionModel) -> LocalizationMap:
        """Return the input of scorers with an occlusion model."""
        from wheretolook.inputs.localization_map import LocalizationMap

        return LocalizationMap(self._map_with_images, self.camera, occlusion, self.device)

    @cached_property
    def _map_with_images(self) -> Map:
        return self.map.with_images()

    # Geometry

    @cached_property
    def is_photographed(self) -> bool:
        """Whether the scene is known from photographs alone."""
        if isinstance(self.files, SceneFolder):
            return self.files.is_photographed
        return self.files.mesh is None and self.files.depth is None

    @property
    def has_mesh(self) -> bool:
        """Whether there is a mesh."""
        if isinstance(self.files, ColmapFiles):
            return self.files.mesh is not None
        return "mesh" in vars(self) or self.files.mesh.is_file()

    @property
    def has_depth(self) -> bool:
        """Whether there are depth images: those of a dataset's scene are rendered from the mesh."""
        return self.files.depth is not None if isinstance(self.files, ColmapFiles) else self.has_mesh

    @cached_property
    def mesh(self) -> TexturedMesh:
        """The mesh, of a COLMAP model with or without colours."""
        from wheretolook.scenes.loading import load_mesh

        if isinstance(self.files, SceneFolder):
            return load_mesh(self.files.mesh)
        assert self.files.mesh is not None
        return load_mesh(self.files.mesh, self.files.mesh_up, colored=False).transformed(self.frame.world_from_map)

    @cached_property
    def depth_images(self) -> DepthImages:
        """Depth images of the mapping images: read, or rendered where the mapping images were taken."""
        from wheretolook.mapping.depth_images import read_depth_images

        if isinstance(self.files, SceneFolder):
            model = read_model(self.files.map)
            mapped = only_camera(cameras_by_id(model.cameras, self.files.map), self.files.map)
            return RenderedDepth(self.renderer, mapped, colmap_poses(self.files.map, model))
        assert self.files.depth is not None
        images = read_depth_images(self.files.model, self.files.depth, self.files.depth_scale)
        place = self.frame.world_from_map.apply_to_poses
        return [replace(image, cam_from_world=place(image.cam_from_world)) for image in images]

    @cached_property
    def renderer(self) -> Renderer:
        """Renders the mesh."""
        from wheretolook.rendering.warp_renderer import WarpRenderer

        return WarpRenderer(self.mesh, self.device)

    @property
    def raycaster(self) -> MeshRaycaster:
        """Casts rays against the mesh."""
        return self.mesh_space.raycaster

    @cached_property
    def mesh_space(self) -> FreeSpace:
        """Where a camera can be according to the mesh; that of a COLMAP model is compared with the landmarks."""
        from wheretolook.space.free_space import FreeSpace

        space = FreeSpace(self.mesh, self.free_space, self.device)
        if isinstance(self.files, ColmapFiles) and self.files.mesh is not None:
            warn_of_mesh(self.files.mesh, self.landmarks.points, space.raycaster)
        return space

    @cached_property
    def mapped_space(self) -> MappedSpace:
        """Where a camera can be according to landmarks and mapping images."""
        from wheretolook.space.mapped_space import MappedSpace

        poses = np.empty((0, 3, 4)) if self.map.mapping_poses is None else self.map.mapping_poses
        return MappedSpace(self.landmarks.points, camera_centers(poses.astype(np.float64)), self.mapped_space_config)

    @cached_property
    def tsdf_space(self) -> FreeSpace:
        """Where a camera can be according to the depth images."""
        from wheretolook.space.free_space import TsdfSpace

        images = self.depth_images
        return TsdfSpace(self.tsdf_volume, images, self.free_space, self.device, self.progress)

    @cached_property
    def tsdf_volume(self) -> TsdfVolume:
        """The truncated signed distance field fused from the depth images."""
        config = self.given_occlusion
        return TsdfVolume.from_images(self.depth_images, config.voxel_m, config.max_depth_m, self.progress)

    @property
    def sampled_space(self) -> FreeSpace | MappedSpace:
        """Where viewpoints are sampled: the same for all occlusion models."""
        return self.mapped_space if self.is_photographed else self.mesh_space

    @property
    def space(self) -> FreeSpace | MappedSpace:
        """Where a camera can be: by depth images with occlusion "tsdf" or without a mesh, else `sampled_space`."""
        by_depth = self.occlusion_config.model == "tsdf" or (self.has_depth and not self.has_mesh)
        return self.tsdf_space if by_depth else self.sampled_space

    def free_voxels(self, views: ViewLattice, space: FreeSpace | MappedSpace) -> tuple[VoxelGrid, NDArray[np.int64]]:
        """The voxels of a lattice over a space, and the ids of the free ones, ascending.

        Raises SceneError if no voxel is free.
        """
        from wheretolook.dataset.sampling import free_locations

        grid = views.voxels(space.bounds)
        free = free_locations(grid, space)
        # depth images that have not seen all of the scene may put free space behind surfaces
        return grid, free[~self.occlusion.inside_geometry(grid.centers()[free])]

    # Occlusion

    @property
    def available_occlusion(self) -> tuple[str, ...]:
        """Names of the occlusion models that can be made here, the most accurate first."""
        available = {"": True, "mesh": self.has_mesh, "depth images": self.has_depth}
        return tuple(name for name, kind in OCCLUSION_MODELS.items() if available[kind.needs])

    def check_occlusion(self, name: str) -> None:
        """Raise ConfigError if an occlusion model is unknown or cannot be made here."""
        check_occlusion_names((name,))
        if name not in self.available_occlusion:
            problem = f"{self.name} lacks what this occlusion model needs: {OCCLUSION_MODELS[name].needs}"
            raise ConfigError(problem, value=name, fix=f"Use {' or '.join(self.available_occlusion)}.")

    @property
    def occlusion_config(self) -> OcclusionConfig:
        """The configured model, or hidden-point removal if that needs a mesh and a dataset's scene has photographs only."""
        config = self.given_occlusion
        replaced = OCCLUSION_MODELS[config.model].needs and self.is_photographed
        return replace(config, model="hidden-points") if replaced else config

    @property
    def occlusion(self) -> OcclusionModel:
        """Decides which landmarks are unoccluded from any location."""
        return self.occlusion_model(self.occlusion_config.model)

    def occlusion_model(self, name: str) -> OcclusionModel:
        """Make the occlusion model of a name in `available_occlusion`, with the options given."""
        if name not in self._occlusion_models:
            self.check_occlusion(name)
            model: OcclusionModel = resolve_name(OCCLUSION_MODELS[name].model).from_inputs(self)
            if self.cache_bytes and name != "none":
                from wheretolook.visibility.occlusion import CachedOcclusion

                model = CachedOcclusion(model, self.cache_bytes)
            self._occlusion_models[name] = model
        return self._occlusion_models[name]


class RenderedDepth:
    """Depth images of poses (B, 3, 4), each rendered when it is accessed."""

    def __init__(self, renderer: Renderer, camera: Camera, cam_from_world: Float) -> None:
        self.renderer = renderer
        self.camera = camera
        self.cam_from_world = cam_from_world

    def __len__(self) -> int:
        return len(self.cam_from_world)

    def __getitem__(self, index: int) -> DepthImage:

        pose = self.cam_from_world[index]
        return DepthImage(self.renderer.render(self.camera, pose[None]).depth_m[0], self.camera, pose)
