"""The procedural apartment: closed, reachable, deterministic, and both plain and rich in texture."""

from functools import cache

import numpy as np
import open3d as o3d
import pytest
from scipy import ndimage

from wheretolook.scenes.config import ApartmentConfig
from wheretolook.utils.errors import ConfigError
from wheretolook_rooms import decor, fixtures, furniture, patches as patches_module
from wheretolook_rooms.generator import furnish_apartment
from wheretolook_rooms.materials import plain
from wheretolook_rooms.plan import draw_plan
from wheretolook_rooms.style import Style

SEEDS = (0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2)))
CONFIG = ApartmentConfig()


@cache
def furnished(seed):
    plan, patches, _, _ = furnish_apartment(CONFIG, seed)
    return plan, patches_module.join(patches)


def _raycasting_scene(surface):
    scene = o3d.t.geometry.RaycastingScene()
    vertices, triangles = surface.vertices.astype(np.float32), surface.triangles.astype(np.uint32)
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    return scene


def _cast(scene, origins, directions):
    rays = np.concatenate(np.broadcast_arrays(origins, directions), -1).astype(np.float32)
    return {name: values.numpy() for name, values in scene.cast_rays(o3d.core.Tensor(rays)).items()}


def _unit_vectors(rng):
    vectors = rng.normal(size=(20_000, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", SEEDS)
def test_shell_is_closed(seed):
    plan, surface = furnished(seed)
    scene = _raycasting_scene(surface)
    directions = _unit_vectors(np.random.default_rng(seed))
    low, high = surface.vertices.min(0) - 1e-4, surface.vertices.max(0) + 1e-4
    for room in plan.rooms:
        centre = np.array([(room.x0 + room.x1) / 2, (room.y0 + room.y1) / 2, plan.height - 0.75])
        hit = _cast(scene, centre, directions)
        ends = centre + hit["t_hit"][:, None] * directions
        assert ((ends > low) & (ends < high)).all()
        front = (hit["primitive_normals"] * directions).sum(1) < 0
        assert front.mean() > 0.98  # walls face the room


@pytest.mark.parametrize("seed", SEEDS)
def test_every_room_is_reached_on_foot(seed):
    """Flood fill over the floor: where nothing stands between 0.05 m and 1.9 m, shrunk by a walker of 0.4 m width."""
    plan, surface = furnished(seed)
    scene = _raycasting_scene(surface)
    step = 0.05
    low = surface.vertices.min(0)[:2]
    high = surface.vertices.max(0)[:2]
    x, y = (np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True))
    grid = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), 1.9)], -1).reshape(-1, 3)
    hit = _cast(scene, grid, np.array([0.0, 0, -1]))
    on_floor = (np.abs(hit["t_hit"] - 1.9) < 0.05) & (hit["primitive_normals"][:, 2] > 0.9)
    free = ndimage.binary_erosion(on_floor.reshape(len(x), len(y)), iterations=4)
    labels, _ = ndimage.label(free)
    main = np.bincount(labels[labels > 0]).argmax()
    for room in plan.rooms:
        inside = np.ix_((x > room.x0) & (x < room.x1), (y > room.y0) & (y < room.y1))
        assert (labels[inside] == main).sum() * step**2 > 0.5, f"{room.kind} cannot be entered"


FURNITURE = {
    "sofa": lambda s: furniture.sofa(s, 3),
    "bed": lambda s: furniture.bed(s, 1.6),
    "chair": lambda s: furniture.chair(s, s.wood, s.upholstery),
    "plant": lambda s: decor.plant(s, 1.2, 30, 0.35),
    "kitchen": lambda s: fixtures.kitchen_run(s, 2.4, 2.6, False),
    "bathtub": lambda s: fixtures.bathtub(s, 1.7),
    "curtain": lambda s: fixtures.curtain(0.5, 2.0, s.upholstery),
}


@pytest.mark.parametrize("name", FURNITURE)
def test_furniture_is_closed_and_faces_outward(name):
    """With equal points merged, each directed edge occurs as often as its reverse; rays from outside meet a front."""
    surface = patches_module.join(FURNITURE[name](Style(np.random.default_rng(3), 0.5, 0.5)))
    _, point = np.unique(np.floor(surface.vertices * 1e6 + 0.33), axis=0, return_inverse=True)
    corner = point.ravel()[surface.triangles]
    edges = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    sign = np.sign(edges[:, 1] - edges[:, 0])
    _, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    assert (np.bincount(which.ravel(), weights=sign) == 0).all()

    rng = np.random.default_rng(0)
    low, high = surface.vertices.min(0), surface.vertices.max(0)
    directions = _unit_vectors(rng)
    origins = rng.uniform(low, high, directions.shape) - 2 * np.linalg.norm(high - low) * directions
    hit = _cast(_raycasting_scene(surface), origins, directions)
    struck = np.isfinite(hit["t_hit"])
    front = (hit["primitive_normals"] * directions).sum(1) < 1e-6
    assert struck.mean() > 0.05 and front[struck].mean() > 0.999


SIDES = 64
CIRCLE = 0.5 * SIDES * np.sin(2 * np.pi / SIDES)  # area of the polygon in a unit circle
SHEET = np.stack(np.meshgrid([0.5, -0.5], [0.0], [1.0, 0.0], indexing="ij"), -1)[:, 0].transpose(1, 0, 2)


@pytest.mark.parametrize(
    ("make", "expected", "tolerance"),
    [
        (lambda paint: patches_module.box((1, 2, 3), (1.5, 2.4, 3.3), paint), 0.5 * 0.4 * 0.3, 1e-6),
        (lambda paint: patches_module.cylinder(0.3, 0.2, 0.9, paint, sides=SIDES), CIRCLE * 0.3**2 * 0.7, 1e-6),
        (
            lambda paint: patches_module.tube([(0, 0, z) for z in (0, 0.5, 1)], 0.1, paint, sides=SIDES),
            CIRCLE * 0.01,
            1e-6,
        ),
        # a box of edge 2 rounded to a sphere of radius 1, from the inside
        (
            lambda paint: patches_module.cushion((-1,) * 3, (1,) * 3, paint, radius_m=1.0, rounding=12),
            4 / 3 * np.pi,
            0.03,
        ),
        (lambda paint: patches_module.slab_between(SHEET, SHEET - (0, 0.1, 0), paint, (1, 1)), 0.1, 1e-6),
    ],
)
def test_closed_primitives_enclose_their_volume(make, expected, tolerance):
    """Divergence theorem: the signed volume of a closed outward-facing surface is that of the solid."""
    surface = patches_module.join(make(plain(np.random.default_rng(0), (0.5, 0.5, 0.5))))
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(expected, rel=tolerance) and volume < expected * (1 + 1e-6)


def test_plans_are_sound():
    for seed in range(30):
        n_rooms = 3 + seed % 4
        plan = draw_plan(np.random.default_rng(seed), n_rooms, 13.0 * n_rooms, 0.5)
        assert len(plan.rooms) == n_rooms
        assert len(plan.doors) >= n_rooms - 1
        reached = {0}
        for _ in plan.rooms:
            reached |= {b for a, b in plan.doors if a in reached} | {a for a, b in plan.doors if b in reached}
        assert reached == set(range(n_rooms))
        assert sum(room.kind == "bathroom" for room in plan.rooms) == 1
        assert sum(not room.lamp_on for room in plan.rooms) == round(0.5 * n_rooms)
        for a in plan.rooms:
            for b in plan.rooms[a.index + 1 :]:
                assert min(a.x1, b.x1) <= max(a.x0, b.x0) or min(a.y1, b.y1) <= max(a.y0, b.y0)


def test_apartments_of_before_keep_their_key():
    before = {
        "n_rooms": None, "area_m2": None, "texture_richness": 0.85, "clutter": 0.85, "dark_rooms": 0.2,
        "texels_per_m": 125.0, "texture_size": 4096, "light_spacing_m": 0.1, "light_rays": 24,
    }  # fmt: skip
    assert ApartmentConfig().key() == before  # or all that was made from them would be made again
    assert ApartmentConfig(vary=True).key() == {**before, "vary": True}


@pytest.mark.parametrize(
    "options",
    [{"n_rooms": 2}, {"repetition": -0.1}, {"enlarged": 0.0}, {"clutter": 1.5}, {"area_m2": 5.0}, {"light_rays": 0}],
)
def test_invalid_options_are_rejected(options):
    with pytest.raises(ConfigError):
        ApartmentConfig(**options)
