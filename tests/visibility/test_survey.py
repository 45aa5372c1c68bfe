"""The survey of all locations: blocks, threads, the best K, stored occlusion and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_array_equal

from box_scenes import box_quads, quads_mesh, random_texture
from twins.visibility import count_plain
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import rotation_looking_along
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.utils.errors import ConfigError, MapError, SceneError
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.counting import FrustumCounter, SurveyOptions, survey
from wheretolook.visibility.counting_kernel import best_kernel
from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion, OcclusionModel


def boxes(*quads):
    return quads_mesh(np.concatenate(quads), [random_texture(np.random.default_rng(0), 4, 4)])


class Given(OcclusionModel):
    """A mask that is known."""

    def __init__(self, locations, mask):
        self.locations = locations
        self.mask = mask

    def unoccluded(self, locations, points):
        rows = [int(np.flatnonzero((self.locations == location).all(1))[0]) for location in locations]
        return self.mask[rows]


@pytest.mark.parametrize("threads", [1, 3])
def test_a_survey_is_what_its_plain_parts_say(random_views, threads, device):
    v = random_views
    rotations = rotation_looking_along(v.directions)
    options = SurveyOptions(keep=6, device=device, threads=threads)
    seen = survey(v.camera, rotations, v.locations, v.points, Given(v.locations, v.mask), options)
    plain = count_plain(v.camera, rotations, v.locations, v.points, v.mask)
    assert_array_equal(seen.counts, plain)
    for row in range(len(v.locations)):
        ranked = sorted(range(len(rotations)), key=lambda direction: (-plain[row, direction], direction))
        assert seen.best[row].tolist() == ranked[:6]
    assert seen.occlusion.name == "custom"
    assert_array_equal(seen.occlusion.mask, v.mask)
    assert_array_equal(seen.occlusion.unoccluded(v.locations[2:4], v.points), v.mask[2:4])


@pytest.mark.parametrize(("directions", "keep"), [(1, 1), (40, 40), (300, 7)])
def test_the_best_directions_are_those_of_a_stable_sort(directions, keep, device):
    counts = np.random.default_rng(0).integers(0, 9, (6, directions)).astype(np.int32)
    best = wp.empty((6, keep), dtype=wp.int32, device=start_warp(device))
    wp.launch(best_kernel, counts.shape, [wp.array(counts, device=device), directions, keep], [best], device=device)
    assert_array_equal(best.numpy(), np.argsort(-counts, axis=1, kind="stable")[:, :keep])


@pytest.mark.parametrize("n_points", [1, 7, 8, 9, 800])
def test_masks_of_every_length_are_packed_as_numpy_packs_them(n_points, random_views, device):
    v = random_views
    mask = v.mask[:, :n_points]
    points = v.points[:n_points]
    rotations = rotation_looking_along(v.directions)
    for occlusion, expected in ((Given(v.locations, mask), mask), (NoOcclusion(), np.ones_like(mask))):
        seen = survey(v.camera, rotations, v.locations, points, occlusion, SurveyOptions(device=device))
        assert_array_equal(seen.occlusion.packed, np.packbits(expected, axis=1))


def test_a_mesh_hides_what_is_behind_it_on_the_device_too(rng, device):
    raycaster = MeshRaycaster(boxes(box_quads((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))), device)
    points = rng.uniform(-4, 4, (600, 3))
    locations = rng.uniform(2, 4, (20, 3))
    occlusion = MeshOcclusion(raycaster)
    rotations = rotation_looking_along(fibonacci_sphere(30))
    seen = survey(PinholeCamera(), rotations, locations, points, occlusion, SurveyOptions(device=device))
    mask = occlusion.unoccluded(locations, points)
    assert 0 < (~mask).sum() < mask.size / 2 and seen.occlusion is not None
    assert_array_equal(seen.occlusion.mask, mask)
    assert_array_equal(seen.counts, count_plain(PinholeCamera(), rotations, locations, points, mask))


def test_blocks_keep_to_the_memory_allowed(random_views, device, monkeypatch):
    v = random_views
    rotations = rotation_looking_along(random_views.directions)
    locations = np.random.default_rng(0).uniform(-2, 2, (40, 3))
    options = SurveyOptions(device=device)
    whole = survey(v.camera, rotations, locations, v.points, NoOcclusion(), options)
    blocks = []
    original = FrustumCounter.count

    def spy(self, at, *rest):
        blocks.append(len(at))
        return original(self, at, *rest)

    monkeypatch.setattr(FrustumCounter, "count", spy)
    one = FrustumCounter(v.camera, rotations, len(v.points), device).bytes_per_location(len(v.points)) + len(v.points)
    for threads, memory, longest in ((1, 7 * one + 5, 7), (8, one, 1)):
        blocks.clear()
        limited = replace(options, threads=threads, memory_bytes=memory)
        part = survey(v.camera, rotations, locations, v.points, NoOcclusion(), limited)
        assert_array_equal(part.counts, whole.counts)
        assert sum(blocks) == 40 and max(blocks) <= longest


@pytest.mark.parametrize(
    ("error", "locations", "points", "options"),
    [
        (MapError, np.zeros((1, 3)), np.empty((0, 3)), {}),
        (SceneError, np.empty((0, 3)), np.ones((5, 3)), {}),
        (SceneError, [[0, np.nan, 0]], np.ones((5, 3)), {}),
        (ConfigError, np.zeros((1, 3)), np.ones((5, 3)), {"memory_bytes": 100}),
    ],
)
def test_invalid_input(error, locations, points, options):
    with pytest.raises(error):
        survey(PinholeCamera(), np.eye(3)[None], locations, points, NoOcclusion(), SurveyOptions(**options))


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_location_inside_geometry_is_refused(two_sided, device):
    room = box_quads((-3, -3, -3), (3, 3, 3), inward=True)
    occlusion = MeshOcclusion(MeshRaycaster(boxes(room, box_quads((0, 0, 0), (1, 1, 1))), device), two_sided=two_sided)
    points = np.ones((5, 3))
    occlusion.check(np.array([[-1.0, -1, -1], [2, 2, 2]]), points)
    with pytest.raises(SceneError):
        occlusion.check(np.array([[1, 0.5, 0.5]]), points)  # on a face
    inside = np.array([[-1.0, -1, -1], [0.4, 0.5, 0.6]])
    if two_sided:
        occlusion.check(inside, points)  # might be a room
    else:
        with pytest.raises(SceneError):
            survey(PinholeCamera(), np.eye(3)[None], inside, points, occlusion, SurveyOptions(device=device))
