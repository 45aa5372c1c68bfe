"""Counts by cells of the sphere against the plain twin, exactly; and what must not change them."""

import numpy as np
import pytest
import warp as wp
from numpy.testing import assert_array_equal

from twins.visibility import count_plain
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import rotation_looking_along
from wheretolook.visibility import frustum
from wheretolook.visibility.counting import FrustumCounter
from wheretolook.visibility.frustum import cells_of, octahedral_directions, tabulate
from wheretolook.visibility.occlusion import DevicePoints

DISTORTED = ColmapCamera("OPENCV", 640, 480, (300.0, 310.0, 330.0, 235.0, -0.2, 0.05, 1e-3, -1e-3))
FISHEYE = ColmapCamera("OPENCV_FISHEYE", 640, 480, (200.0, 200.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0))
PANORAMA = ColmapCamera("EQUIRECTANGULAR", 640, 320, (640.0, 320.0))
CAMERAS = {
    "wide": PinholeCamera(640, 480, 320.0),
    "narrow": PinholeCamera(100, 300, 800.0),
    "very wide": PinholeCamera(640, 480, 30.0),
    "distorted": DISTORTED,
    "fisheye": FISHEYE,
    "panorama": PANORAMA,
}


def count(
    camera, rotations, locations, points, mask = None,
    device = "cpu", **options,
):  # fmt: skip
    on_device = DevicePoints(points, device)
    free = None if mask is None else wp.array(mask[:, on_device.order], dtype=wp.bool, device=device)
    counter = FrustumCounter(camera, rotations, len(points), device, **options)
    return counter.count(locations, on_device.double, free).numpy()


@pytest.mark.parametrize("name", CAMERAS)
def test_counts_are_those_of_the_plain_twin(name, random_views, device):
    v = random_views
    camera = CAMERAS[name]
    rng = np.random.default_rng(5)
    # twins of landmarks share pixels; some landmarks are closer to a location than the least depth, some in it
    points = np.concatenate(
        [v.points, v.points[:200], v.locations[0] + rng.normal(size=(60, 3)) * 10.0 ** rng.uniform(-5, -2, (60, 1)),
         v.locations[:2], [[np.nan, 0, 0], [np.inf, 0, 0]], rng.normal(size=(60, 3)) * 1e37]
    )  # fmt: skip
    mask = rng.random((len(v.locations), len(points))) < 0.7
    rotations = rotation_looking_along(v.directions)
    counts = count(camera, rotations, v.locations, points, mask, device)
    plain = count_plain(camera, rotations, v.locations, points, mask)
    assert_array_equal(counts, plain)
    assert plain.max() > 5 and (name == "panorama" or plain.min() < plain.max())


def test_a_hundred_thousand_landmarks_on_the_very_border(rng, device):
    """Landmarks made to lie within single precision's error of the sides of some view: each must be decided alike."""
    camera = PinholeCamera()
    rotations = rotation_looking_along(fibonacci_sphere(40))
    pixels = np.stack([rng.choice([0.0, 640.0], 100_000), rng.uniform(0, 480, 100_000)], 1)
    pixels[::2] = np.stack([rng.uniform(0, 640, 50_000), rng.choice([0.0, 480.0], 50_000)], 1)
    rays = np.concatenate([(pixels - (320, 240)) / 320, np.ones((100_000, 1))], 1) * rng.uniform(0.5, 8, (100_000, 1))
    points = np.einsum("nji,nj->ni", rotations[rng.integers(0, 40, 100_000)], rays)
    mask = np.ones((1, len(points)), bool)
    counts = count(camera, rotations, np.zeros((1, 3)), points, device=device)
    assert_array_equal(counts, count_plain(camera, rotations, np.zeros((1, 3)), points, mask))


@pytest.mark.parametrize("camera", [DISTORTED, FISHEYE, PANORAMA])
def test_the_table_of_a_field_of_view_is_never_wrong(rng, camera):
    table = tabulate(camera)
    u, v = rng.uniform(-1, 1, (2, 300_000))
    directions = octahedral_directions(u, v)
    depth = table.depth_rad[cells_of(directions, table.size)]
    seen = camera.sees(directions)
    assert seen[depth > 0].all() and not seen[depth < 0].any()
    assert np.mean(depth == 0) < 0.02


@pytest.mark.parametrize(
    "camera",
    [
        ColmapCamera("SIMPLE_PINHOLE", 640, 480, (4e5, 320.0, 240.0)),
        ColmapCamera("SIMPLE_PINHOLE", 4096, 1, (4000.0, 2048.0, 0.5)),
        ColmapCamera("PINHOLE", 640, 480, (300.0, 500.0, -100.0, 900.0)),
    ],
)
def test_a_view_narrower_than_the_tables_cells_is_counted_too(rng, camera, device):
    pixels = rng.uniform(-0.5, 1.5, (2000, 2)) * (camera.width, camera.height)
    points = camera.unproject(pixels) * rng.uniform(1, 5, (2000, 1))
    rotations = np.concatenate([np.eye(3)[None], rotation_looking_along(fibonacci_sphere(5))])
    counts = count(camera, rotations, np.zeros((1, 3)), points, device=device)
    assert_array_equal(counts, count_plain(camera, rotations, np.zeros((1, 3)), points, np.ones((1, 2000), bool)))
    assert 300 < counts[0, 0] < 1000


def test_lists_for_the_camera_that_run_over_change_nothing(random_views, device, monkeypatch):
    v = random_views
    rotations = rotation_looking_along(random_views.directions)
    expected = count(DISTORTED, rotations, v.locations, v.points, v.mask, device)
    monkeypatch.setattr(frustum, "OFFSETS_AT_ONCE", 7)
    for entries in (1, 60):  # shorter than the list of one view, and than that of all
        short = {"scratch_bytes": 20 * entries}
        found = count(DISTORTED, rotations, v.locations, v.points, v.mask, device, **short)
        assert_array_equal(found, expected)
