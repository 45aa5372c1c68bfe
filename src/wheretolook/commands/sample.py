"""`wheretolook sample`: viewpoints, and which landmarks their locations see."""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from wheretolook.commands.map import SceneOrMapOptions, imports_map
from wheretolook.commands.options import Log, Progress, existing, ignore_progress, load_dataset, naming_file, open_scene
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.dataset_lock import changes_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.geometry.camera import Camera, draw_camera, write_cameras
from wheretolook.mapping.colmap_model import colmap_poses
from wheretolook.utils.errors import MapError, SceneError
from wheretolook.utils.files import cache_key


@dataclass(frozen=True, kw_only=True)
class Sample(SceneOrMapOptions):
    """Choose viewpoints by the landmarks they see.

    Examples:
      wheretolook sample --config configs/demo.yaml --sample.max_locations 100
      wheretolook sample --map sparse/0

    Args:
        sample: which viewpoints.
    """

    sample: SampleConfig = field(default_factory=SampleConfig)

    @imports_map
    @changes_dataset("sample")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Dataset:
        """Write viewpoints and the landmarks that their locations see, `<scene>/viewpoints.parquet`, `occlusion.npz`.

        A camera looks in every direction from the centre of every free voxel, and visible landmarks are counted
        exactly. In a scene of photographs, the camera stays near where these were taken; without a mesh, hidden-point
        removal decides what is occluded. Raises SceneError if no location is free, MapError if there is no
        map, or one without a scale.
        """
        dataset = load_dataset(self, "map")
        for files in dataset.scenes:
            scene = open_scene(self, files)
            cache = files.stage_cache("sample", _key(scene, self.sample))
            if cache.is_current(files.table, files.occlusion):
                log(f"{scene.name}: reusing {files.table}")
            else:
                _sample(scene, self.sample, log)
                cache.store()
            progress(1)
        return dataset


def _key(scene: Scene, config: SampleConfig) -> str:
    files = scene.folder
    space = asdict(scene.free_space)
    stage = "scenes"
    if scene.is_photographed:
        space = asdict(scene.mapped_space_config)
        stage = "map"
    chosen = {name: value for name, value in asdict(config).items() if name != "memory_gb"}
    for name in ("cameras", "near_map", "any_lens"):
        if not chosen[name]:  # keys of datasets that were sampled before this option existed
            del chosen[name]
    chosen["max_directions"] = config.directions_of(files.split)
    made_from = [existing(files.source, SceneError, stage), existing(files.landmarks, MapError, "map")]
    settings = [chosen, scene.occlusion_config.settings(), space, scene.camera.record()]
    return cache_key("sample", [*settings, *made_from])


def _cameras(scene: Scene, config: SampleConfig) -> Camera | dict[int, Camera]:
    """Return the scene's camera, or those drawn for it by number; other scenes do not change the draw."""
    if not config.cameras:
        return scene.camera
    rng = np.random.default_rng([config.seed, zlib.crc32(scene.name.encode())])
    return {number: draw_camera(rng, config.any_lens) for number in range(1, config.cameras + 1)}


def _sample(scene: Scene, config: SampleConfig, log: Log) -> None:
    from wheretolook.dataset.sampling import sample_viewpoints
    from wheretolook.dataset.viewpoint_files import write_table

    files = scene.folder
    with naming_file(files.source):
        grid, free = scene.free_voxels(config, scene.sampled_space)
        cameras = _cameras(scene, config)
        title = f"sample {scene.name}"
        config = replace(config, max_directions=config.directions_of(files.split))
        mapped = colmap_poses(files.map) if config.near_map else None
        table, occlusion = sample_viewpoints(
            grid, free, scene.landmarks, cameras, scene.occlusion, config, scene.device, title, mapped
        )
    files.stage_cache("sample").clear()
    files.cameras_file.unlink(missing_ok=True)
    if isinstance(cameras, dict):
        write_cameras(cameras, files.cameras_file)
    occlusion.save(files.occlusion)
    write_table(table, files.table)
    n_locations = table["location_id"].nunique()
    log(f"{scene.name}: {len(table):,} viewpoints at {n_locations} of {len(free)} free locations -> {files.table}")
    if scene.occlusion_config != scene.given_occlusion:
        log(f"{scene.name}: occlusion by {scene.occlusion_config.model}, as there is no mesh")
