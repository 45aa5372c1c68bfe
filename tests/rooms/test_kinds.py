"""Halls, courts, offices and buildings: drawn from their seeds, closed, and copies where they are to be copies."""

from functools import cache
from itertools import combinations
from typing import get_args

import numpy as np
import pytest

from wheretolook.commands.options import ScenesConfig
from wheretolook.dataset.layout import SceneFolder
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import ConfigError
from wheretolook_rooms.building import MAX_DIFFERENCE, draw_building
from wheretolook_rooms.generator import generate_scene
from wheretolook_rooms.patches import join

FAST = ApartmentConfig(texels_per_m=20, texture_size=2048, light_rays=4, light_spacing_m=1.0)
KINDS = tuple(kind for kind in get_args(SceneKind) if kind != "apartment")
SLOW = pytest.mark.slow


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[] if kind == "building" else SLOW) for kind in KINDS])
def test_mesh_is_well_formed_and_follows_from_the_seed(kind):
    mesh, mapped = generate_scene(kind, FAST, 4)
    again, mapped_again = generate_scene(kind, FAST, 4)
    for name in ("vertices", "triangles", "corner_uvs", "triangle_texture"):
        assert getattr(mesh, name).tobytes() == getattr(again, name).tobytes()
    (texture,) = mesh.textures
    assert texture.tobytes() == again.textures[0].tobytes() and mapped == mapped_again

    assert mesh.vertices.dtype == np.float32 and np.isfinite(mesh.vertices).all()
    assert mesh.triangles.dtype == np.int32 and 5_000 <= len(mesh.triangles) <= 400_000
    assert mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.vertices)
    assert mesh.corner_uvs.min() >= 0 and mesh.corner_uvs.max() <= 1
    low, high = mesh.bounds
    assert low[2] == pytest.approx(0, abs=0.005)
    space = FreeSpace(mesh)
    points = np.random.default_rng(0).uniform([*low[:2], 1.2], [*high[:2], 1.8], size=(400, 3))
    free = points[space.is_free(points)]
    assert not space.two_sided and len(free) > 80  # walls face the inside, and one can stand there
    angle = np.arange(12) * np.pi / 6
    around = np.stack([np.cos(angle), np.sin(angle), np.full(12, -0.1)], axis=1)
    hits = space.raycaster.cast(np.repeat(free, 12, axis=0), np.tile(around, (len(free), 1)))
    assert np.isfinite(hits.distance_m).all() and hits.front.mean() > 0.98
    column, row = (mesh.corner_uvs[hits.triangle].mean(1) * texture.shape[1::-1]).astype(int).T
    assert 60 < np.median(texture[row, column]) < 225  # neither black nor burnt


@cache
def drawn_building(seed):
    return draw_building(ApartmentConfig(clutter=0.3), seed)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=SLOW) for seed in (1, 2, 3))])
def test_copies_of_a_building_are_copies(seed):
    furnished, module, copies = drawn_building(seed)
    n_mapped = sum(copy.mapped for copy in copies)
    assert 2 <= len(copies) <= 8 and n_mapped >= 1
    assert len(furnished.mapped) == 1 + n_mapped  # the corridor beside them
    assert len(join(furnished.patches).triangles) <= 400_000
    n_rooms = len(module.plan.rooms)
    of_copy = [[p for p in furnished.patches if p.room // n_rooms == k] for k in range(len(copies))]
    same = 0
    for patches in zip(*of_copy, strict=False):  # what they have in common comes first
        own = []
        for copy, patch in zip(copies, patches, strict=True):
            turn = copy.world(np.eye(3)) - copy.world(np.zeros(3))
            own.append((patch.positions - [*copy.shift, 0.0]) @ turn.T)
        same += all(p.shape == own[0].shape and np.allclose(p, own[0], atol=1e-6) for p in own)
    assert same > (1 - MAX_DIFFERENCE) * min(map(len, of_copy))
    for (x0, y0, x1, y1), (a0, b0, a1, b1) in combinations([copy.floor(module.rectangle) for copy in copies], 2):
        assert min(x1, a1) <= max(x0, a0) or min(y1, b1) <= max(y0, b0)


def test_kinds_take_turns():
    scenes = ScenesConfig(kinds=("apartment", "hall", "court"))
    assert [scenes.kind_of(seed) for seed in range(3, 8)] == ["apartment", "hall", "court", "apartment", "hall"]
    assert ScenesConfig().kind_of(7) == "apartment"
    with pytest.raises(ConfigError):
        ScenesConfig(kinds=())
    with pytest.raises(ConfigError):
        ScenesConfig(kinds=("castle",))


def test_mapped_floor_is_stored_with_the_mesh(tmp_path):
    scene = SceneFolder(tmp_path / "building-001", "train")
    floor = ((0.0, 0.0, 2.5, 1.0), (3.0, 0.0, 4.0, 1.0))
    assert scene.mapped_floor() == ()
    scene.save_mapped_floor(floor)
    assert scene.mapped_floor() == floor
    scene.save_mapped_floor(())
    assert scene.mapped_floor() == ()
