"""Map, camera, occlusion, free space and renderer of a place, each made once when it is first needed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, cameras_by_id, only_camera
from wheretolook.geometry.lattices import ViewLattice, VoxelGrid
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.mapping.config import FrameOptions, place_name
from wheretolook.mapping.georeference import read_scale
from wheretolook.mapping.map_frame import IDENTITY, MapFrame, has_photographs, read_frame
from wheretolook.space.config import FreeSpaceConfig, MappedSpaceConfig
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError, check_positive
from wheretolook.visibility.config import OCCLUSION_MODELS, OcclusionConfig, check_occlusion_names

if TYPE_CHECKING:  # pandas and Warp are imported when first needed
    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.geometry.mesh import TexturedMesh
    from wheretolook.geometry.tsdf import DepthImage, DepthImages, TsdfVolume
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.mapping.landmarks import Landmarks
    from wheretolook.mapping.mapped_images import ColmapSource, MappedImages
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.rendering.warp_renderer import Renderer
    from wheretolook.space.free_space import FreeSpace, MappedSpace
    from wheretolook.visibility.occlusion import OcclusionModel


@dataclass(frozen=True)
class EnvironmentConfig:
    """Options of an environment."""

    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)
    free_space: FreeSpaceConfig = field(default_factory=FreeSpaceConfig)  # with a mesh or depth images
    mapped_space: MappedSpaceConfig = field(default_factory=MappedSpaceConfig)  # with photographs alone
    occlusion_cache_bytes: int = 0  # memory for lines of sight that are asked for again


class Environment(ABC):
    """A map with its camera, occlusion models, free space and renderer; world in metres, z up.

    `SceneEnvironment` opens a scene of a dataset, `ColmapEnvironment` a COLMAP model. Every part is computed when it is
    first used, and kept. `device` runs the kernels: "cpu", a CUDA device, or "auto" for the first GPU. `progress` shows
    bars where depth images are fused.

    Raises (when a part is first used):
        SceneError: the mesh or the depth images are missing or cannot be used.
        MapError: the map is missing, damaged, or not in metres.
        ConfigError: unknown device or occlusion model, or the voxels of a TSDF exceed the memory.
    """

    name: str
    camera: Camera  # of the views

    def __init__(self, config: EnvironmentConfig, device: str, progress: bool) -> None:
        self.config = config
        self.progress = progress
        self._device = device
        self._occlusion_models: dict[str, OcclusionModel] = {}

    @cached_property
    def device(self) -> str:
        """The device that runs kernels, such as "cpu" or "cuda:0"."""
        return usable_device(self._device)

    # What the sources provide

    @property
    @abstractmethod
    def landmarks(self) -> Landmarks:
        """The map's landmarks."""

    @property
    @abstractmethod
    def mapping_poses(self) -> Float | None:
        """Poses cam_from_world (M, 3, 4) of the mapping images; None if unknown."""

    @property
    @abstractmethod
    def images(self) -> MappedImages | None:
        """The mapping images with their observations; None if they are unknown or rendered."""

    @property
    def frame(self) -> MapFrame:
        """The frame that users give and get coordinates in."""
        return IDENTITY

    @property
    @abstractmethod
    def mesh(self) -> TexturedMesh:
        """The mesh."""

    @property
    @abstractmethod
    def depth_images(self) -> DepthImages:
        """Depth images of the mapping images."""

    @property
    @abstractmethod
    def has_mesh(self) -> bool:
        """Whether `mesh` is available."""

    @property
    @abstractmethod
    def has_photographs(self) -> bool:
        """Whether the mapping images are photographs, as those of an imported model; else they are rendered."""

    @property
    def has_depth(self) -> bool:
        """Whether `depth_images` are available: by default, rendered from the mesh."""
        return self.has_mesh

    @property
    @abstractmethod
    def space(self) -> FreeSpace | MappedSpace:
        """Where a camera can be."""

    # What follows from these

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
        """Where a camera can be according to the mesh."""
        from wheretolook.space.free_space import FreeSpace

        return FreeSpace(self.mesh, self.config.free_space, self.device)

    @cached_property
    def mapped_space(self) -> MappedSpace:
        """Where a camera can be according to landmarks and mapping images."""
        from wheretolook.space.free_space import MappedSpace

        poses = np.empty((0, 3, 4)) if self.mapping_poses is None else self.mapping_poses
        return MappedSpace(self.landmarks.points, camera_centers(poses.astype(np.float64)), self.config.mapped_space)

    @cached_property
    def tsdf_space(self) -> FreeSpace:
        """Where a camera can be according to the depth images."""
        from wheretolook.space.free_space import TsdfSpace

        images = self.depth_images
        return TsdfSpace(self.tsdf_volume, images, self.config.free_space, self.device, self.progress)

    @cached_property
    def tsdf_volume(self) -> TsdfVolume:
        """The truncated signed distance field fused from the depth images."""
        from wheretolook.geometry.tsdf import TsdfConfig, TsdfVolume

        occlusion = self.config.occlusion
        tsdf = TsdfConfig(voxel_size_m=occlusion.voxel_m, max_depth_m=occlusion.max_depth_m)
        return TsdfVolume.from_images(self.depth_images, tsdf, self.progress)

    def free_voxels(self, views: ViewLattice, space: FreeSpace | MappedSpace) -> tuple[VoxelGrid, NDArray[np.int64]]:
        """The voxels of a lattice over a space, and the ids of the free ones, ascending.

        Raises SceneError if no voxel is free.
        """
        from wheretolook.dataset.sampling import free_locations

        grid = views.voxels(space.bounds)
        free = free_locations(grid, space)
        # depth images that have not seen all of the scene may put free space behind surfaces
        return grid, free[~self.occlusion.inside_geometry(grid.centers()[free])]

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
        """The occlusion model that is used, and its options."""
        return self.config.occlusion

    @property
    def occlusion(self) -> OcclusionModel:
        """Decides which landmarks are unoccluded from any location."""
        return self.occlusion_model(self.occlusion_config.model)

    def occlusion_model(self, name: str) -> OcclusionModel:
        """Make the occlusion model of a name in `available_occlusion`, with the options of `config.occlusion`."""
        if name not in self._occlusion_models:
            self.check_occlusion(name)
            model: OcclusionModel = resolve_name(OCCLUSION_MODELS[name].model).from_inputs(self)
            if self.config.occlusion_cache_bytes and name != "none":
                from wheretolook.visibility.occlusion import CachedOcclusion

                model = CachedOcclusion(model, self.config.occlusion_cache_bytes)
            self._occlusion_models[name] = model
        return self._occlusion_models[name]

    @cached_property
    def localization_map(self) -> LocalizationMap:
        """The input of scorers, with `occlusion`."""
        from wheretolook.inputs.localization_map import LocalizationMap

        of_map = (self.landmarks, self.camera, self.occlusion, self.device, self.mapping_poses)
        return LocalizationMap(*of_map, self.frame, self.has_photographs, self.images)


class SceneEnvironment(Environment):
    """A scene of a dataset, known from a mesh or from photographs.

    `camera` takes the place of the scene's camera, `mesh` (metres, z up) that of the mesh file.
    """

    def __init__(
        self,
        files: SceneFolder,
        camera: Camera | None = None,
        config: EnvironmentConfig = EnvironmentConfig(),
        device: str = "cpu",
        progress: bool = True,
        mesh: TexturedMesh | None = None,
    ) -> None:
        super().__init__(config, device, progress)
        self.files = files
        self.name = files.name
        self.camera = camera or files.camera
        if mesh is not None:
            self.mesh = mesh

    @cached_property
    def is_photographed(self) -> bool:
        """Whether the scene is known from photographs alone."""
        return self.files.is_photographed

    @cached_property
    def has_photographs(self) -> bool:  # type: ignore[override]
        """Whether the map is of photographs or an imported model, with or without a mesh."""
        return read_scale(self.files.map) is not None

    @cached_property
    def frame(self) -> MapFrame:
        """The own frame of the model that the map was imported from; of other maps, the scene's."""
        return read_frame(self.files.map)

    @property
    def source(self) -> Path:
        """The file that everything follows from: the mesh, or else the poses of the photographs."""
        return self.files.mapping_cameras if self.is_photographed else self.files.mesh

    @cached_property
    def mesh(self) -> TexturedMesh:  # type: ignore[override]
        """The textured mesh."""
        from wheretolook.scenes.loading import load_mesh

        return load_mesh(self.files.mesh)

    @property
    def has_mesh(self) -> bool:
        """Whether there is a mesh."""
        return "mesh" in vars(self) or self.files.mesh.is_file()

    @cached_property
    def landmarks(self) -> Landmarks:  # type: ignore[override]
        """The map's landmarks."""
        return self.files.read_landmarks()

    @cached_property
    def mapping_poses(self) -> Float | None:  # type: ignore[override]
        """Poses cam_from_world (M, 3, 4) of the mapping images; None if unknown."""
        return self.files.mapping_poses()

    @cached_property
    def images(self) -> MappedImages | None:  # type: ignore[override]
        """The photographs with their observations; None if images are rendered or there is no COLMAP model."""
        from wheretolook.mapping.colmap_model import holds_model
        from wheretolook.mapping.mapped_images import read_images

        return (
            read_images(self.files.map, self.landmarks)
            if self.has_photographs and holds_model(self.files.map)
            else None
        )

    @cached_property
    def depth_images(self) -> DepthImages:  # type: ignore[override]
        """Depth images rendered where the map's images were taken."""
        from wheretolook.mapping.colmap_model import colmap_poses, read_model

        model = read_model(self.files.map)
        mapped = only_camera(cameras_by_id(model.cameras, self.files.map), self.files.map)
        return RenderedDepth(self.renderer, mapped, colmap_poses(self.files.map, model))

    @cached_property
    def mapped_space(self) -> MappedSpace:
        """Where a camera can be according to the photographs."""
        _ = self.frame  # an error if the map's unit is unknown
        return super().mapped_space

    @property
    def sampled_space(self) -> FreeSpace | MappedSpace:
        """Where viewpoints are sampled: the same for all occlusion models."""
        return self.mapped_space if self.is_photographed else self.mesh_space

    @property
    def space(self) -> FreeSpace | MappedSpace:
        """Where a camera can be: with occlusion "tsdf" according to depth images, else `sampled_space`."""
        tsdf = self.config.occlusion.model == "tsdf" and not self.is_photographed
        return self.tsdf_space if tsdf else self.sampled_space

    @property
    def occlusion_config(self) -> OcclusionConfig:
        """The configured model, or hidden-point removal if that needs a mesh and the scene has photographs only."""
        config = self.config.occlusion
        replaced = OCCLUSION_MODELS[config.model].needs and self.is_photographed
        return replace(config, model="hidden-points") if replaced else config


@dataclass(frozen=True)
class ColmapFiles:
    """A COLMAP model, and files in its frame."""

    model: Path
    mesh: Path | None = None
    depth: Path | None = None  # folder of depth images, see `wheretolook.mapping.depth_images.read_depth_images`
    depth_scale: float = 1000.0  # units of integer depth images in a metre
    database: Path | None = None  # COLMAP database or hloc features, for the landmarks' ambiguity
    max_reprojection_error_px: float | None = None  # landmarks with a larger mean error are dropped
    frame: FrameOptions = FrameOptions()  # how its frame is related to the world


class ColmapEnvironment(Environment):
    """A COLMAP model, known from its landmarks and optionally a mesh or depth images.

    `camera` is a camera or a camera_id, None for the model's only one. `occlusion` is the name of an occlusion model,
    empty for the most accurate one available; it takes the place of `config.occlusion.model`.

    Raises:
        ConfigError: the occlusion model is unknown or its files are missing, or a value is out of range.
    """

    def __init__(
        self,
        files: ColmapFiles,
        camera: Camera | int | None = None,
        occlusion: str = "",
        config: EnvironmentConfig = EnvironmentConfig(),
        device: str = "cpu",
    ) -> None:
        super().__init__(config, device, progress=True)
        self.files = files
        self.name = place_name(files.model)
        self._camera = camera
        if files.mesh is not None and files.depth is not None:
            raise ConfigError("give a mesh or depth images, not both", value=str(files.depth))
        if files.max_reprojection_error_px is not None:
            check_positive("the largest reprojection error", files.max_reprojection_error_px)
        name = occlusion or self.available_occlusion[0]
        self.check_occlusion(name)
        self.config = replace(config, occlusion=replace(config.occlusion, model=name))

    @cached_property
    def _map(self) -> ColmapSource:
        from wheretolook.mapping.mapped_images import open_colmap

        files = self.files
        depth_scale = None
        if files.depth is not None:
            from wheretolook.mapping.depth_images import metres_per_unit

            depth_scale = metres_per_unit(files.model, files.depth, files.depth_scale)
        limit_px = files.max_reprojection_error_px
        opened = (files.model, self._camera, files.database, limit_px, self.device)
        return open_colmap(*opened, files.frame, depth_scale)

    @property
    def frame(self) -> MapFrame:
        """The model's own frame."""
        return self._map.frame

    @property
    def camera(self) -> Camera:  # type: ignore[override]
        """The camera of the views."""
        return self._map.camera

    @property
    def landmarks(self) -> Landmarks:
        """The map's landmarks."""
        return self._map.landmarks

    @property
    def mapping_poses(self) -> Float:
        """Poses cam_from_world (M, 3, 4) of the mapping images."""
        return self._map.mapping_poses

    @property
    def images(self) -> MappedImages:
        """The mapping images with their observations."""
        return self._map.images

    @property
    def has_mesh(self) -> bool:
        """Whether a mesh was given."""
        return self.files.mesh is not None

    @property
    def has_photographs(self) -> bool:
        """Whether the model's images are photographs, see `wheretolook.mapping.map_frame.has_photographs`."""
        return has_photographs(self.files.model)

    @property
    def has_depth(self) -> bool:
        """Whether depth images were given."""
        return self.files.depth is not None

    @cached_property
    def mesh(self) -> TexturedMesh:  # type: ignore[override]
        """The mesh, with or without colours."""
        from wheretolook.scenes.loading import load_mesh

        assert self.files.mesh is not None
        return load_mesh(self.files.mesh, colored=False).transformed(self.frame.world_from_map)

    @cached_property
    def depth_images(self) -> DepthImages:  # type: ignore[override]
        """Depth images of the model's images."""
        from wheretolook.mapping.depth_images import read_depth_images

        assert self.files.depth is not None
        images = read_depth_images(self.files.model, self.files.depth, self.files.depth_scale)
        place = self.frame.world_from_map.apply_to_poses
        return [replace(image, cam_from_world=place(image.cam_from_world)) for image in images]

    @property
    def space(self) -> FreeSpace | MappedSpace:
        """Where a camera can be, by mesh, depth images, or the map alone."""
        if self.has_mesh:
            return self.mesh_space
        return self.tsdf_space if self.has_depth else self.mapped_space

    @cached_property
    def localization_map(self) -> LocalizationMap:
        """The input of scorers; warns if the mesh seems to be in another frame."""
        from wheretolook.mapping.map_frame import warn_of_mesh

        result = super().localization_map
        if self.files.mesh is not None:
            warn_of_mesh(self.files.mesh, self.landmarks.points, self.raycaster)
        return result


class RenderedDepth:
    """Depth images of poses (B, 3, 4), each rendered when it is accessed."""

    def __init__(self, renderer: Renderer, camera: Camera, cam_from_world: Float) -> None:
        self.renderer = renderer
        self.camera = camera
        self.cam_from_world = cam_from_world

    def __len__(self) -> int:
        return len(self.cam_from_world)

    def __getitem__(self, index: int) -> DepthImage:
        from wheretolook.geometry.tsdf import DepthImage

        pose = self.cam_from_world[index]
        return DepthImage(self.renderer.render(self.camera, pose[None]).depth_m[0], self.camera, pose)
