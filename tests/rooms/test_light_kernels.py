"""The kernels of baked light against plain twins in NumPy, where rays meet a box or a screen in closed form."""

import numpy as np
import pytest
import warp as wp

from wheretolook.utils.warp import start_warp, vec3_array
from wheretolook_rooms.light_kernels import direct_kernel, gather_kernel

R2 = np.array([3242174889, 2447445414], dtype=np.uint64)


def r2(index):
    """Points (..., 2) of Roberts' R2 sequence in 32-bit whole numbers."""
    return ((index.astype(np.uint64)[..., None] * R2) % 2**32) / 2**32


def integers(values, device):
    return wp.array(np.asarray(values, dtype=np.int32), dtype=wp.int32, device=device)


def quads(corners, device):
    """A mesh of quadrilaterals (Q, 4, 3)."""
    index = (np.array([0, 1, 2, 0, 2, 3]) + 4 * np.arange(len(corners))[:, None]).reshape(-1)
    return wp.Mesh(points=vec3_array(corners.reshape(-1, 3), device), indices=integers(index, device))


def box(inward):
    """The six faces of the cube [-1, 1]^3, two for each axis, low side first."""
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            u = np.eye(3)[(axis + 1) % 3]
            v = np.eye(3)[(axis + 2) % 3]
            normal = side * np.eye(3)[axis]
            face = np.stack([normal + s * u + t * v for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
            outward = side > 0  # the order above turns around +axis
            faces.append(face[::-1] if outward == inward else face)
    return np.stack(faces)


def direct(screen, points, normals, lamps, rays, device):
    """Light at points from a window in the plane x = 2 (1 m square, facing -x, radiance 1) and from white lamps."""
    device = start_warp(device)
    mesh = quads(screen, device)
    light, soft = (wp.empty(len(points), dtype=wp.vec3, device=device) for _ in range(2))
    corner = np.array([[2.0, 0.5, 0.5]])
    right = np.array([[0, -1.0, 0]])
    down = np.array([[0, 0, -1.0]])
    rooms = np.zeros(len(points))
    inputs = [mesh.id, *(vec3_array(values, device) for values in (points, normals)), integers(rooms, device)]
    inputs += [vec3_array(values, device) for values in (corner, right, down)]
    inputs += [integers([0], device), integers([0], device), rays, wp.vec3(1.0, 1.0, 1.0)]
    inputs += [vec3_array(lamps, device), vec3_array(np.ones_like(lamps), device)]
    inputs += [integers(np.zeros(len(lamps)), device), 64]
    wp.launch(direct_kernel, len(points), inputs, [light, soft], device=device)
    return light.numpy()


SCREEN = np.array([[[1.0, -0.4, -9], [1, 9, -9], [1, 9, 9], [1, -0.4, 9]]])
WALL = np.array([[[1.0, -9, -9], [1, 9, -9], [1, 9, 9], [1, -9, 9]]])
"""`SCREEN` blocks rays that cross the plane x = 1 at y > -0.4, `WALL` all rays to the window."""


def test_window_light_is_that_of_its_plain_twin(device):
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, -1], [0.5, 1, 1], (50, 3))
    normals = rng.normal(size=(50, 3)) + np.array([1.5, 0, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rays = 32
    light = direct(SCREEN, points, normals, np.zeros((0, 3)), rays, device)
    facing = np.cross([0, 0, -1.0], [0, -1.0, 0])
    np.testing.assert_allclose(facing, [-1, 0, 0])
    expected = np.zeros(50)
    for k, (point, normal) in enumerate(zip(points, normals, strict=True)):
        p = point + 0.004 * normal
        uv = r2(k * rays + np.arange(rays))
        q = np.array([2.0, 0.5, 0.5]) - uv[:, :1] * [0, 1.0, 0] - uv[:, 1:] * [0, 0, 1.0] + 0.06 * facing
        d = q - p
        distance = np.linalg.norm(d, axis=1)
        cosines = np.maximum(d @ normal, 0) * np.maximum(-(d @ facing), 0) / distance**2
        crossing = p[1] + d[:, 1] * (1 - p[0]) / d[:, 0]
        expected[k] = np.sum(cosines / distance**2 * (crossing < -0.4)) / rays / np.pi
    np.testing.assert_allclose(light[:, 0], expected, rtol=2e-3, atol=2e-5)
    assert (expected > 0).sum() > 8 and (expected == 0).sum() > 3


@pytest.mark.parametrize("height_m", [0.5, 1.0, 2.0])
def test_lamp_light_falls_with_the_square_of_the_distance(height_m, device):
    points = np.zeros((200, 3))
    normals = np.tile([0.0, 0, 1], (200, 1))
    light = direct(WALL, points, normals, np.array([[0.0, 0, height_m]]), 4, device)
    np.testing.assert_allclose(light[:, 0].mean(), 1 / height_m**2, rtol=0.02)
    assert np.all(direct(WALL, points, -normals, np.array([[0.0, 0, height_m]]), 4, device)[:, 0] == 0)


def gather(faces, points, normals, brightness, rays, device):
    """Light reflected by the faces of a box, each of one brightness, and the shares of open and back rays."""
    device = start_warp(device)
    mesh = quads(faces, device)
    bounced = wp.empty(len(points), dtype=wp.vec3, device=device)
    shares = [wp.empty(len(points), dtype=wp.float32, device=device) for _ in range(2)]
    n = len(faces)
    st = wp.array(np.full((2 * n, 3, 2), 0.5, np.float32), dtype=wp.vec2, device=device)
    shape = wp.array(np.ones((n, 2), np.int32), dtype=wp.vec2i, device=device)
    albedo = np.full((n, 3), 0.5)
    light = np.repeat(brightness[:, None], 3, 1)
    inputs = [mesh.id, vec3_array(points, device), vec3_array(normals, device), rays]
    inputs += [integers(np.repeat(np.arange(n), 2), device), st, integers(np.arange(n), device), shape]
    inputs += [vec3_array(albedo, device), vec3_array(light, device)]
    wp.launch(gather_kernel, len(points), inputs, [bounced, *shares], device=device)
    return bounced.numpy(), shares[0].numpy(), shares[1].numpy()


def test_gathered_light_is_that_of_its_plain_twin(device):
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.9, 0.9, (40, 3))
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rays = 64
    brightness = np.array([0.1, 0.7, 0.2, 1.3, 0.4, 2.0])
    bounced, open_share, back_share = gather(box(inward=True), points, normals, brightness, rays, device)
    for k, (point, n) in enumerate(zip(points, normals, strict=True)):
        p = point + 0.004 * n
        helper = np.array([0.0, 1, 0]) if abs(n[0]) > 0.7 else np.array([1.0, 0, 0])
        a = np.cross(n, helper)
        a /= np.linalg.norm(a)
        u, turn = r2(k * rays + np.arange(rays)).T
        sideways = np.column_stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)]) @ np.stack([a, np.cross(n, a)])
        d = np.sqrt(u)[:, None] * sideways + np.sqrt(1 - u)[:, None] * n  # cosine-weighted about the normal
        reach = (np.sign(d) - p) / d
        axis = reach.argmin(1)
        face = 2 * axis + (d[np.arange(rays), axis] > 0)
        np.testing.assert_allclose(bounced[k], 0.5 * brightness[face].mean(), rtol=0.03)  # a ray at an edge may differ
        np.testing.assert_allclose(open_share[k], np.minimum(reach.min(1) / 0.6, 1).mean(), rtol=1e-3)
    assert np.all(back_share == 0)


def test_a_uniform_box_throws_back_albedo_times_light_and_its_backs_are_noticed(device):
    points = np.zeros((4, 3))
    normals = np.eye(4, 3) + np.eye(4, 3, -3)
    bounced, _, back = gather(box(inward=True), points, normals, np.full(6, 0.8), 32, device)
    np.testing.assert_allclose(bounced, 0.4, rtol=1e-5)
    assert np.all(back == 0)
    bounced, _, back = gather(box(inward=False), points, normals, np.full(6, 0.8), 32, device)
    assert np.all(bounced == 0) and np.all(back == 1)
