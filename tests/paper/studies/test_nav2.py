"""Paths of least cost over the cells of a mask."""

import numpy as np
import pytest

from wheretolook.planning.nav2 import write_mask
from wheretolook_paper.studies.nav2 import CellGraph, read_costs


class Walls:
    """A space in which no segment crosses the line x = 2 below y = 3."""

    def segments_are_free(self, a, b):
        return ~((np.minimum(a[:, 0], b[:, 0]) <= 2) & (np.maximum(a[:, 0], b[:, 0]) > 2) & (a[:, 1] < 3))


@pytest.fixture
def points():
    x, y = np.meshgrid(np.arange(0.5, 5), np.arange(0.5, 5), indexing="ij")
    return np.stack([x, y, np.full_like(x, 1.4)], axis=-1).reshape(-1, 3)


def test_paths_lead_around_walls_and_costs(points, tmp_path):
    cells = CellGraph.of(points, Walls(), 1.0)
    around = cells.path(np.zeros(25), 0, 20)  # from (0.5, 0.5) to (4.5, 0.5)
    assert around[:, 1].max() == 3.5
    row = points[:, 1] == 3.5
    write_mask(tmp_path / "mask", points, np.where(row, 0.0, 1.0), 1.0)
    costs = read_costs(tmp_path / "mask", points, 1.0)
    np.testing.assert_allclose(costs, np.where(row, 0.99, 0.0))
    straight = cells.path(0 * costs, 3, 23)  # from (0.5, 3.5) to (4.5, 3.5)
    np.testing.assert_array_equal(straight[:, 1], 3.5)
    aside = cells.path(costs, 3, 23)
    assert (aside[1:-1, 1] == 4.5).all()
    assert np.linalg.norm(np.diff(aside, axis=0), axis=1).sum() == pytest.approx(2 + 2 * np.sqrt(2))


def test_pairs_are_apart_and_connected(points):
    pairs = CellGraph.of(points, Walls(), 1.0).draw_pairs(5, 4.0, 0)
    assert pairs.shape == (5, 2)
    assert (np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) >= 4).all()
