"""Changed scenes: pieces are moved as they are or are gone, all else stays, and the light is another."""

from functools import cache
from itertools import groupby

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from wheretolook.scenes.config import ApartmentConfig
from wheretolook_rooms import atlas, furniture
from wheretolook_rooms.building import building
from wheretolook_rooms.court import court
from wheretolook_rooms.generator import apartment, generate_scene
from wheretolook_rooms.large import SUN_M
from wheretolook_rooms.materials import NoiseBank
from wheretolook_rooms.office import office
from wheretolook_rooms.patches import Patch, join
from wheretolook_rooms.style import Style
from wheretolook_rooms.variant import REACH_M, changed

SEED = 5
FAST = ApartmentConfig(n_rooms=3, texels_per_m=20, texture_size=2048, light_rays=4, light_spacing_m=0.5)
MAKE = {"apartment": apartment, "building": building, "office": office, "court": court}
Runs = list[tuple[list[Patch], list[Patch]]]


@cache
def drawn(kind, strength):
    """A scene and the same changed."""
    scene = MAKE[kind](FAST, SEED)
    return scene, changed(scene, strength, SEED)


@cache
def mesh(changes=0.0):
    return generate_scene("apartment", FAST, SEED, changes=changes)[0]


def sorted_runs(kind, strength):
    """Runs of patches before and after: what is fixed, pieces that stay, are moved, are removed."""
    before, after = drawn(kind, strength)
    fixed = []
    still = []
    moved = []
    removed = []
    end = 0
    for piece, parts in groupby(before.patches, key=lambda patch: patch.piece):
        old = [*parts]
        new = after.patches[end : end + len(old)]
        end += len(old)
        assert all(patch.piece is piece for patch in new)
        at = still if piece is not None else fixed
        if not any(len(patch.triangles()[0]) for patch in new):
            at = removed
        elif any((a.positions != b.positions).any() for a, b in zip(old, new, strict=True)):
            at = moved
        at.append((old, new))
    assert end == len(after.patches)
    return fixed, still, moved, removed


def points(patches):
    return np.concatenate([patch.positions.reshape(-1, 3) for patch in patches])


@pytest.mark.parametrize("kind", ["apartment", "office", pytest.param("building", marks=pytest.mark.slow)])
def test_pieces_are_moved_rigidly_or_are_gone_and_all_else_stays(kind):
    fixed, still, moved, removed = sorted_runs(kind, 1.0)
    assert all(a is b for old, new in [*fixed, *still] for a, b in zip(old, new, strict=True))
    pieces = len(still) + len(moved) + len(removed)
    assert pieces > 15 and 0.1 < len(removed) / pieces < 0.45 and len(moved) >= 3
    assert all(patch.piece is not None for old, _ in removed for patch in old)
    for old, new in moved:
        before, after = points(old), points(new)
        shift = (before.min(0) + before.max(0) - after.min(0) - after.max(0)) / 2
        assert (np.abs(shift) <= REACH_M + 0.5).all()  # turning changes the bounds
        np.testing.assert_allclose(after[:, 2], before[:, 2], atol=1e-9)  # it stands as high as before
        np.testing.assert_allclose(pdist(after[::7]), pdist(before[::7]), atol=1e-9)
        assert all(a.material is b.material for a, b in zip(old, new, strict=True))


def bounds(patches):
    """The least and greatest coordinates (P, 3) of each patch."""
    each = [points([patch]) for patch in patches]
    return np.array([p.min(0) for p in each]), np.array([p.max(0) for p in each])


def test_moved_pieces_stand_on_something_and_do_not_overlap():
    _, after = drawn("apartment", 1.0)
    *_, moved, _ = sorted_runs("apartment", 1.0)
    present = [patch for patch in after.patches if len(patch.triangles()[0])]
    low, high = bounds(present)
    for _, new in moved:
        other = np.array([patch.piece is not new[0].piece for patch in present])
        begin, end = bounds(new)
        bottom = begin[:, 2].min()
        flat = other & (np.abs(low[:, 2] - bottom) < 0.01) & (np.abs(high[:, 2] - bottom) < 0.01)
        assert ((low[flat, :2] < begin.min(0)[:2]) & (end.max(0)[:2] < high[flat, :2])).all(1).any()
        inside = (begin[:, None] + 0.0101 < high[other]) & (low[other] + 0.0101 < end[:, None])
        assert not inside.all(2).any()


def test_more_changes_at_a_higher_strength():
    counts = [len(moved) + len(removed) for *_, moved, removed in (sorted_runs("apartment", s) for s in (0.2, 0.6, 1))]
    assert 0 < counts[0] < counts[1] < counts[2]


def test_patterns_stay_where_they_are_in_the_texture():
    scene, after = drawn("apartment", 1.0)
    plans = [atlas.plan_atlas(one.patches, 10, 2048) for one in (scene, after)]
    np.testing.assert_array_equal(plans[0].corners, plans[1].corners)
    np.testing.assert_array_equal(plans[0].patch_chart, plans[1].patch_chart)
    noise = NoiseBank(np.random.default_rng(0))
    albedos = [atlas.paint_charts(plan, noise) for plan in plans]
    assert all(np.array_equal(a, b) for a, b in zip(*albedos, strict=True))


def test_the_changed_mesh_differs_in_light_and_things_and_follows_from_the_seed():
    before, after = mesh(), mesh(0.8)
    again, mapped = generate_scene("apartment", FAST, SEED, changes=0.8)
    for name in ("vertices", "triangles", "corner_uvs"):
        assert getattr(after, name).tobytes() == getattr(again, name).tobytes()
    assert after.textures[0].tobytes() == again.textures[0].tobytes() and not mapped
    assert len(after.triangles) < len(before.triangles)
    np.testing.assert_array_equal(before.bounds, after.bounds)
    scene, changed_scene = drawn("apartment", 0.8)
    surface = join(scene.patches)
    corners = surface.triangles[np.array([patch.piece is None for patch in scene.patches])[surface.patch]]
    np.testing.assert_array_equal(before.vertices[corners], after.vertices[corners])  # the shell and what is built in
    # windows and lamp shades glow as before, while the light on much else is another
    difference = np.abs(before.textures[0].astype(int) - after.textures[0]).max(-1)
    for pane, patch in enumerate(scene.patches):
        if patch.material.emissive:
            assert changed_scene.patches[pane].material.emissive
            uv = before.corner_uvs[surface.patch == pane] * difference.shape[::-1]
            low, high = np.ceil(uv.min((0, 1))).astype(int), uv.max((0, 1)).astype(int)
            assert not difference[low[1] : high[1], low[0] : high[0]].any()
    assert (difference > 12).mean() > 0.1


def test_without_changes_a_scene_is_the_scene():
    plain = generate_scene("apartment", FAST, SEED, changes=0.0)[0]
    assert plain.textures[0].tobytes() == mesh().textures[0].tobytes()
    assert plain.vertices.tobytes() == mesh().vertices.tobytes()


@pytest.mark.parametrize("kind", ["apartment", "office"])
def test_lamps_are_brighter_or_dimmer(kind):
    before, after = drawn(kind, 0.6)
    factors = [np.divide(b.colour, a.colour) for a, b in zip(before.lamps, after.lamps, strict=True)]
    assert np.ptp(factors, axis=1) == pytest.approx(0, abs=1e-9)
    assert np.min(factors) < 0.9 or np.max(factors) > 1.1
    assert [lamp.position for lamp in before.lamps] == [lamp.position for lamp in after.lamps]


def test_a_court_has_another_sun_or_none():
    suns = []
    for seed in range(6):
        before = court(FAST, seed)
        after = changed(before, 0.5, seed)
        assert not before.lamps or after.lamps != before.lamps
        suns.append(len(after.lamps))
        assert all(np.linalg.norm(lamp.position) == pytest.approx(SUN_M) for lamp in after.lamps)
    assert 0 < sum(suns) < 6


def test_a_chair_copied_with_fixed_things_between_is_several_pieces():
    """Offices place one chair many times, always after its desk."""
    fixed, still, moved, removed = sorted_runs("office", 1.0)
    chair = len(furniture.chair(style := Style(np.random.default_rng(0), 0.5, 0.5), style.wood, style.upholstery))
    chairs = [run for run in (*still, *moved, *removed) if len(run[0]) == chair]
    assert len(chairs) > 3 and len({id(old[0].piece) for old, _ in chairs}) < len(chairs)
    assert fixed
