"""The viewpoint map of a scene of a dataset."""

from __future__ import annotations

from pathlib import Path

from wheretolook.dataset import RELEASE, Dataset, SceneFolder
from wheretolook.geometry import PinholeCamera
from wheretolook.grid import VoxelGrid, direction_lattice
from wheretolook.learning.config import MATCHABILITY
from wheretolook.learning.weights import best_weights, read_weights
from wheretolook.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.planning.config import ViewpointMapConfig
from wheretolook.planning.map_building import build_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.sampling import free_locations
from wheretolook.scenes.free_space import FreeSpace
from wheretolook.scenes.mapped_space import MappedSpace
from wheretolook.scoring import Scorer, load_scorer, make_scorer
from wheretolook.scoring.learned import same_field_of_view
from wheretolook.visibility import OcclusionModel


def scene_viewpoint_map(
    scene: SceneFolder,
    camera: PinholeCamera,
    config: ViewpointMapConfig,
    space: FreeSpace | MappedSpace,
    occlusion: OcclusionModel,
    device: str = "cpu",
) -> ViewpointMap:
    """Build the viewpoint map of a scene, with progress bars.

    Args:
        scene: its files.
        camera: that will look.
        config: voxels, directions and method.
        space: where a camera can be.
        occlusion: which landmarks nothing stands in front of.
        device: where kernels run.

    Raises:
        SceneError: no voxel is free. MapError: there are no landmarks.
        ConfigError: no such method, or it needs weights. WeightsError: the weights cannot be used.
    """
    grid = VoxelGrid.over(space.bounds, config.grid)
    free = free_locations(grid, space)
    free = free[~occlusion.inside_geometry(grid.centers()[free])]  # as in the sample stage
    one = LocalizationMap(Landmarks.load(scene.landmarks), camera, occlusion, device, scene.mapping_poses())
    directions = direction_lattice(config.directions, config.lattice)
    return build_viewpoint_map(
        _scorer(one, config), grid, free, directions, config.lattice, f"viewpoint map {scene.name}"
    )


def default_weights(dataset: Dataset) -> Path | None:
    """The best weights of a dataset, or else of the release beside it if they were trained for the same field of view.

    Raises:
        WeightsError: a record of training is damaged.
    """
    for folder in (dataset.root / "weights", dataset.root.parent / RELEASE / "weights"):
        if any(path.stem != MATCHABILITY for path in folder.glob("*.safetensors")):
            path = best_weights(folder)
            trained = PinholeCamera(**read_weights(path)[1]["camera"])
            if same_field_of_view(trained, dataset.camera):
                return path
    return None


def _scorer(localization_map: LocalizationMap, config: ViewpointMapConfig) -> Scorer:
    if config.weights is not None and not config.method:
        return load_scorer(config.weights, localization_map)
    return make_scorer(config.method or "bins", localization_map, weights=config.weights)
