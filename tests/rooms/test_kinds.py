"""Halls, courts, offices and buildings: drawn from their seeds, closed, and copies where they are to be copies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from all_options import run
from wheretolook.cli import parse_command
from wheretolook.commands.label import Label
from wheretolook.commands.map import Map
from wheretolook.commands.sample import Sample
from wheretolook.commands.scenes import Scenes
from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import poses as poses_of
from wheretolook.geometry.poses import camera_centers
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.scenes.scenes_config import ScenesConfig
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook_rooms.building import MAX_DIFFERENCE, Copy, Module, draw_building
from wheretolook_rooms.court import court
from wheretolook_rooms.generator import generate_scene
from wheretolook_rooms.hall import hall
from wheretolook_rooms.large import Furnished
from wheretolook_rooms.office import office
from wheretolook_rooms.patches import join

FAST = ApartmentConfig(texels_per_m=20, texture_size=2048, light_rays=4, light_spacing_m=1.0)
KINDS = tuple(kind for kind in get_args(SceneKind) if kind != "apartment")
SLOW = pytest.mark.slow


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[] if kind == "building" else SLOW) for kind in KINDS])
def test_mesh_is_well_formed_and_follows_from_the_seed(kind: SceneKind) -> None:
    mesh, mapped = generate_scene(kind, FAST, 4)
    again, mapped_again = generate_scene(kind, FAST, 4)
    for name in ("vertices", "triangles", "corner_uvs", "triangle_texture"):
        assert getattr(mesh, name).tobytes() == getattr(again, name).tobytes()
    assert mesh.textures[0].tobytes() == again.textures[0].tobytes() and mapped == mapped_again

    assert mesh.vertices.dtype == np.float32 and np.isfinite(mesh.vertices).all()
    assert mesh.triangles.dtype == np.int32 and 5_000 <= len(mesh.triangles) <= 400_000
    assert mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.vertices)
    assert mesh.corner_uvs.min() >= 0 and mesh.corner_uvs.max() <= 1
    assert mesh.bounds[0, 2] == pytest.approx(0, abs=0.005)
    space = FreeSpace(mesh)
    (low, high) = mesh.bounds
    points = np.random.default_rng(0).uniform([*low[:2], 1.2], [*high[:2], 1.8], size=(400, 3))
    free = points[space.is_free(points)]
    assert not space.two_sided and len(free) > 80  # walls face the inside, and one can stand there
    around = np.stack([np.cos(angle := np.arange(12) * np.pi / 6), np.sin(angle), np.full(12, -0.1)], axis=1)
    hits = space.raycaster.cast(np.repeat(free, 12, axis=0), np.tile(around, (len(free), 1)))
    assert np.isfinite(hits.distance_m).all() and hits.front.mean() > 0.98
    uv = mesh.corner_uvs[hits.triangle].mean(1) * mesh.textures[0].shape[1::-1]
    column, row = uv.astype(int).T
    assert 60 < np.median(mesh.textures[0][row, column]) < 225  # neither black nor burnt


@SLOW
@pytest.mark.parametrize(
    ("furnish", "sides_m", "heights_m"),
    [(hall, (4, 40), (4, 9)), (court, (6, 40), (5, 15)), (office, (6, 24), (2.6, 3.3))],
)
def test_sizes_are_drawn_from_the_seed(
    furnish: Callable[[ApartmentConfig, int], Furnished], sides_m: tuple[float, float], heights_m: tuple[float, float]
) -> None:
    widths = []
    for seed in range(3):
        config = replace(ApartmentConfig(vary=True).of_seed(seed), clutter=0.0)
        patches = furnish(config, seed).patches
        vertices = join(patches).vertices
        width, depth, height = vertices.max(0) - vertices.min(0)
        widths.append(width)
        assert sides_m[0] < min(width, depth) and max(width, depth) < sides_m[1] + 1
        assert heights_m[0] - 0.1 < height < heights_m[1] + 0.3
    assert np.ptp(widths) > 2


@cache
def drawn_building(seed: int) -> tuple[Furnished, Module, list[Copy]]:
    return draw_building(ApartmentConfig(clutter=0.3), seed)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=SLOW) for seed in (1, 2, 3))])
def test_copies_of_a_building_are_copies(seed: int) -> None:
    furnished, module, copies = drawn_building(seed)
    assert 2 <= len(copies) <= 8 and 1 <= sum(copy.mapped for copy in copies) <= len(copies)
    assert len(furnished.mapped) == 1 + sum(copy.mapped for copy in copies)  # the corridor beside them
    assert len(join(furnished.patches).triangles) <= 400_000
    n_rooms = len(module.plan.rooms)
    of_copy = [[p for p in furnished.patches if p.room // n_rooms == k] for k in range(len(copies))]
    shortest = min(map(len, of_copy))
    same = 0
    for patches in zip(*of_copy, strict=False):  # what they have in common comes first
        own = []
        for copy, patch in zip(copies, patches, strict=True):
            turn = copy.world(np.eye(3)) - copy.world(np.zeros(3))
            own.append((patch.positions - [*copy.shift, 0.0]) @ turn.T)
        same += all(p.shape == own[0].shape and np.allclose(p, own[0], atol=1e-6) for p in own)
    assert same > (1 - MAX_DIFFERENCE) * shortest
    floors = [copy.floor(module.rectangle) for copy in copies]
    for k, (x0, y0, x1, y1) in enumerate(floors):
        for a0, b0, a1, b1 in floors[k + 1 :]:
            assert min(x1, a1) <= max(x0, a0) or min(y1, b1) <= max(y0, b0)


def test_buildings_turn_their_copies() -> None:
    turns = [{copy.quarter_turns for copy in drawn_building(seed)[2]} for seed in range(4)]
    assert set.union(*turns) == {0, 1, 2, 3} and any(len(of_one) > 1 for of_one in turns)


def test_kinds_take_turns() -> None:
    scenes = ScenesConfig(kinds=("apartment", "hall", "court"))
    assert [scenes.kind_of(seed) for seed in range(3, 8)] == ["apartment", "hall", "court", "apartment", "hall"]
    assert ScenesConfig().kind_of(7) == "apartment"
    with pytest.raises(ConfigError, match=r"scenes\.kinds"):
        ScenesConfig(kinds=())
    with pytest.raises(ConfigError, match=r"scenes\.kinds"):
        ScenesConfig(kinds=("castle",))  # type: ignore[arg-type]


def test_mapped_floor_is_kept_beside_the_mesh(tmp_path: Path) -> None:
    scene = SceneFolder(tmp_path / "building-001", "train")
    floor = ((0.0, 0.0, 2.5, 1.0), (3.0, 0.0, 4.0, 1.0))
    assert scene.mapped_floor() == ()
    scene.save_mapped_floor(floor)
    assert scene.mapped_floor() == floor
    (scene.folder / "scene.json").write_text('{"mapped_floor": [[1, 2]]}')
    with pytest.raises(SceneError, match="damaged"):
        scene.mapped_floor()
    scene.save_mapped_floor(())
    assert scene.mapped_floor() == ()


SMALL = """\
name: repeated
camera: {width: 320, height: 240, focal_px: 160}
scenes:
  train: 1
  test: 0
  seed: 410
  kinds: [building]
  apartment: {texels_per_m: 80, texture_size: 2048, light_spacing_m: 0.5, light_rays: 4}
map: {n_images: 50}
sample: {grid: [14, 14, 5], keep: 0, max_locations: 40, max_directions: 4}
label: {workers: 1}
"""


@SLOW
def test_views_of_unmapped_copies_localize_in_mapped_ones(tmp_path: Path) -> None:
    """Images are taken on the mapped floor only; views off it are found metres away, with many inliers."""
    (tmp_path / "small.yaml").write_text(SMALL)
    options = ["--config", str(tmp_path / "small.yaml"), "--data", str(tmp_path), "--device", "cpu"]
    experiment = parse_command("demo", options)
    assert experiment is not None
    for stage in (Scenes, Map, Sample, Label):
        dataset = run(stage, experiment)
    (scene,) = dataset.scenes
    part = np.array(scene.mapped_floor())
    poses = scene.mapping_poses()
    assert poses is not None

    def on_mapped_floor(points: NDArray[np.floating]) -> NDArray[np.bool_]:
        at = points[:, None, :2]
        return ((at >= part[:, :2] - 1e-6) & (at <= part[:, 2:] + 1e-6)).all(-1).any(-1)

    assert on_mapped_floor(camera_centers(poses)).all()
    table = scene.read_table()
    elsewhere = ~on_mapped_floor(camera_centers(poses_of(table)))
    wrong = (table["error_m"] > 2) & (table["n_inliers"] >= 30)
    assert elsewhere.mean() > 0.2 and wrong[elsewhere].mean() > 0.2
    assert wrong[elsewhere].mean() > 3 * wrong[~elsewhere].mean()
