"""A small COLMAP model, to try things on: what one has after mapping one's own rooms, made in seconds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.mapping.building import build_map
from wheretolook.mapping.config import MapConfig
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.scenes.procedural.generator import ApartmentConfig, generate_apartment
from wheretolook.space.free_space import FreeSpace


@dataclass(frozen=True)
class ExampleModel:
    """Files of an example.

    Attributes:
        model: folder of the COLMAP model, metres, z up.
        scan: textured mesh of the same rooms, GLB.
    """

    model: Path
    scan: Path


def make_example_model(
    folder: str | Path,
    n_images: int = 30,
    seed: int = 7,
    apartment: ApartmentConfig = ApartmentConfig(n_rooms=3, area_m2=28),
    camera: PinholeCamera = PinholeCamera(),
) -> ExampleModel:
    """Generate three small rooms and map them from images along a walk; a quarter of a minute on one core.

    Args:
        folder: where to write; a model made there before is made anew.
        n_images: that the model is made from.
        seed: of the rooms.
        apartment: what rooms.
        camera: that maps.

    Raises:
        MapError: the images give no landmark, or something else is in the model's place.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    example = ExampleModel(folder / "model", folder / "scan.glb")
    save_glb(generate_apartment(apartment, seed), example.scan)
    mesh = load_mesh(example.scan)
    config = MapConfig(n_images=n_images)
    build_map(
        mesh, WarpRenderer(mesh), FreeSpace(mesh), camera, config, seed, example.model, MeshRaycaster(mesh), workers=1,
        progress=False,
    )  # fmt: skip
    return example
