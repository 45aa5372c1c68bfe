"""The sample stage: viewpoints, and which landmarks their locations see."""

from __future__ import annotations

from dataclasses import asdict

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset
from wheretolook.dataset.stamps import is_done, stage_key, write_stamp
from wheretolook.stages.inputs import Say, Tick, dataset_after, existing, naming_scene
from wheretolook.utils.errors import MapError, SceneError
from wheretolook.viewpoints.table import write_table


def sample(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 3: viewpoints and which landmarks their locations see, `<scene>/viewpoints.parquet` and `occlusion.npz`.

    Every voxel's free location is looked from in every direction; the landmarks it sees are counted exactly.

    A scene of photographs is free near where these were taken, and occluded by hidden-point removal.

    Raises:
        SceneError: no location is free. MapError: there is no map, or one without a scale.
    """
    from wheretolook.dataset.scene import is_photographed, occlusion_without_mesh, require_metres, space_and_occlusion
    from wheretolook.geometry.lattices import VoxelGrid
    from wheretolook.mapping.landmarks import Landmarks
    from wheretolook.viewpoints.sampling import free_locations, sample_viewpoints

    dataset, device = dataset_after(experiment, "map"), experiment.warp_device
    for scene in dataset.scenes:
        chosen = {name: value for name, value in asdict(experiment.sample).items() if name != "memory_gb"}
        chosen["max_directions"] = experiment.sample.directions_of(scene.split)
        occlusion_config, space_config, source = experiment.occlusion, asdict(experiment.scenes.free_space), scene.mesh
        if photographed := is_photographed(scene):
            require_metres(scene, experiment.map.photographs.assume_metric)
            occlusion_config, source = occlusion_without_mesh(experiment.occlusion), scene.mapping_cameras
            space_config = asdict(experiment.scenes.mapped_space)
        key = stage_key("sample", [chosen, occlusion_config.settings(), space_config, asdict(dataset.camera),
                                   existing(source, SceneError, "map" if photographed else "scenes"),
                                   existing(scene.landmarks, MapError, "map")])  # fmt: skip
        if not is_done(scene, "sample", key, scene.table, scene.occlusion):
            landmarks = Landmarks.load(scene.landmarks)
            with naming_scene(source):
                space, occlusion = space_and_occlusion(
                    scene, dataset.camera, experiment, occlusion_config, free_by_tsdf=False
                )
                grid = VoxelGrid.over(space.bounds, experiment.sample.grid)
                free = free_locations(grid, space)
                # depth images that have not seen all of the scene may put free space behind surfaces
                free = free[~occlusion.inside_geometry(grid.centers()[free])]
                table, stored = sample_viewpoints(
                    grid, free, landmarks, dataset.camera, occlusion, experiment.sample, device,
                    progress=f"sample {scene.name}", split=scene.split,
                )  # fmt: skip
            stored.save(scene.occlusion)
            write_table(table, scene.table)
            write_stamp(scene, "sample", key)
            say(f"{scene.name}: {len(table):,} viewpoints at {table['location_id'].nunique()} of {len(free)} free "
                f"locations -> {scene.table}")  # fmt: skip
            if photographed and occlusion_config != experiment.occlusion:
                say(f"{scene.name}: occlusion by {occlusion_config.model}, as there is no mesh")
        else:
            say(f"{scene.name}: reusing {scene.table}")
        tick(1)
    return dataset
