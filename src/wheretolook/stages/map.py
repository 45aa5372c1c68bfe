"""The map stage: a COLMAP model of every scene."""

from __future__ import annotations

import zlib
from dataclasses import asdict

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset
from wheretolook.dataset.stamps import is_done, stage_key, write_stamp
from wheretolook.stages.inputs import Say, Tick, dataset_after, existing, naming_scene, refuse_release
from wheretolook.utils.errors import SceneError


def make_maps(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 2: a COLMAP model of every scene with its landmarks' attributes, `<scene>/map/`.

    With `map.photographs.images`, of a scene made of the photographs there; see `map_photograph_scene`.

    Raises:
        SceneError, MapError: a mesh cannot be read, or no landmark could be triangulated.
    """
    if experiment.map.photographs.images is not None:
        from wheretolook.stages.photographs import map_photograph_scene

        refuse_release(experiment.root)
        return map_photograph_scene(experiment, say, tick)
    from wheretolook.mapping.building import build_map
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.rendering.warp_renderer import WarpRenderer
    from wheretolook.scenes.loading import load_mesh
    from wheretolook.space.free_space import FreeSpace

    dataset, device = dataset_after(experiment, "scenes"), experiment.warp_device
    settings = {name: value for name, value in asdict(experiment.map).items() if name != "photographs"}
    for scene in dataset.scenes:
        seed = zlib.crc32(scene.name.encode()) % 2**31  # the scene's own, whichever scenes are beside it
        key = stage_key("map", [settings, asdict(experiment.scenes.free_space), asdict(dataset.camera), seed,
                           existing(scene.mesh, SceneError, "scenes")])  # fmt: skip
        model = [scene.map / name for name in ("cameras.bin", "images.bin", "points3D.bin")]
        if not is_done(scene, "map", key, scene.landmarks, *model):
            mesh = load_mesh(scene.mesh)
            raycaster = MeshRaycaster(mesh, device)
            with naming_scene(scene.mesh):
                report = build_map(
                    mesh,
                    WarpRenderer(mesh, device),
                    FreeSpace(mesh, experiment.scenes.free_space, device),
                    dataset.camera,
                    experiment.map,
                    seed=seed,
                    out_dir=scene.map,
                    workers=experiment.n_workers,
                    raycaster=raycaster,
                    device=device,
                )
            write_stamp(scene, "map", key)
            say(f"{scene.name}: {report.n_landmarks:,} landmarks from {report.n_registered} images, median "
                f"{report.median_distance_to_mesh_cm:.2f} cm from the mesh -> {scene.map}")  # fmt: skip
        else:
            say(f"{scene.name}: reusing {scene.map}")
        tick(1)
    return dataset
