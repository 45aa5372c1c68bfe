"""A small example of a COLMAP model with its textured mesh, generated in seconds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.rendered_map import build_map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.space.free_space import FreeSpace
from wheretolook_rooms.generator import generate_apartment

SEED = 7  # of the rooms


@dataclass(frozen=True)
class ExampleModel:
    """Folder of a COLMAP model (metres, z up), and the textured mesh of the same rooms (GLB)."""

    model: Path
    scan: Path


def make_example_model(folder: str | Path) -> ExampleModel:
    """Generate three rooms and map them from 30 images along a walk, in 15 seconds on one core.

    An earlier model in this folder is replaced. Raises MapError without any landmark.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    example = ExampleModel(Path(folder) / "model", Path(folder) / "scan.glb")
    save_glb(generate_apartment(ApartmentConfig(n_rooms=3, area_m2=28), SEED), example.scan)
    mesh = load_mesh(example.scan)
    space = FreeSpace(mesh)
    config = MapConfig(n_images=30)
    scene = (mesh, WarpRenderer(mesh), space)
    build_map(*scene, PinholeCamera(), config, SEED, example.model, space.raycaster, workers=1, progress=False)
    return example
