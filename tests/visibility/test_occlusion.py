"""Occlusion by a mesh against a closed form, and what is stored of it."""

import numpy as np
import pytest

from box_scenes import quads_mesh
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.utils.errors import TableError
from wheretolook.visibility.occlusion import MeshOcclusion, StoredOcclusion


def screen():
    """A square of 1 m in the plane x = 1, centred on the x axis."""
    corners = [(1, -0.5, -0.5), (1, 0.5, -0.5), (1, 0.5, 0.5), (1, -0.5, 0.5)]
    return quads_mesh([corners], [np.zeros((1, 1, 3), np.uint8)])


def test_a_screen_hides_what_lies_in_its_shadow():
    rng = np.random.default_rng(0)
    locations = np.array([[0.0, 0, 0], [0, 0.3, -0.2], [3, 0, 0]])
    points = rng.uniform([-1, -2, -2], [4, 2, 2], (2000, 3))
    seen = MeshOcclusion(MeshRaycaster(screen()), margin_m=0.0).unoccluded(locations, points)
    for row, location in enumerate(locations):
        along = (1 - location[0]) / (points[:, 0] - location[0])  # where the line crosses the plane x = 1
        crossing = location + along[:, None] * (points - location)
        hidden = (along > 0) & (along < 1) & (np.abs(crossing[:, 1:]) < 0.5).all(1)
        np.testing.assert_array_equal(seen[row], ~hidden)
        assert 20 < hidden.sum() < 1000


def test_a_landmark_on_a_surface_is_not_hidden_by_it():
    points = np.array([[1.0, 0, 0], [1.03, 0.1, 0.1], [1.3, 0, 0]])
    seen = MeshOcclusion(MeshRaycaster(screen()), margin_m=0.05).unoccluded(np.zeros((1, 3)), points)
    assert seen.tolist() == [[True, True, False]]


def test_stored_occlusion_comes_back_by_location(tmp_path):
    rng = np.random.default_rng(1)
    locations = rng.normal(size=(6, 3))
    mask = rng.random((6, 21)) < 0.5
    points = np.zeros((21, 3))
    path = tmp_path / "occlusion.npz"
    StoredOcclusion.from_mask(locations, mask).save(path)
    stored = StoredOcclusion.load(path)
    order = np.array([4, 0, 4, 2])
    np.testing.assert_array_equal(stored.unoccluded(locations[order] + 1e-7, points), mask[order])
    with pytest.raises(TableError):
        stored.unoccluded(locations[:1] + 0.01, points)
    with pytest.raises(TableError):
        stored.unoccluded(locations, points[:20])
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(TableError):
        StoredOcclusion.load(path)
