"""Information against automatic differentiation, its metrics against NumPy, and the kernel against its plain twin."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from paper.fisher.twins import eigenvalues_plain, information_matrices
from wheretolook.geometry.pose_information import bearing_numbers
from wheretolook_paper.fisher.metrics import TRACE, eigenvalues, metric_of, metric_of_eigenvalues


def turn_of(vector):
    """The matrix (3, 3) that multiplies as the cross product."""
    x, y, z = vector
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def bearing_about_camera(change, rotation, center, points):
    """Bearings (N, 3) in the camera, whose centre is shifted and whose axes are turned, both along the world's axes."""
    turned = torch.linalg.matrix_exp(turn_of(change[3:])) @ rotation
    offsets = (points - (center + change[:3])) @ turned
    return offsets / offsets.norm(dim=1, keepdim=True)


def bearing_about_origin(change, rotation, center, points):
    """The same with the pose T (world from camera) changed to Exp(change) T, as in the released code."""
    zeros = torch.zeros(1, 4, dtype=torch.float64)
    twist = torch.cat([torch.column_stack([turn_of(change[3:]), change[:3]]), zeros])
    pose = torch.cat([torch.column_stack([rotation, center]), torch.eye(4, dtype=torch.float64)[3:]])
    inverse = torch.linalg.inv(torch.linalg.matrix_exp(twist) @ pose)
    offsets = points @ inverse[:3, :3].T + inverse[:3, 3]
    return offsets / offsets.norm(dim=1, keepdim=True)


def differentiated(bearing, rotation, center, points):
    """J^T J (6, 6), summed over landmarks."""
    fixed = [torch.as_tensor(value, dtype=torch.float64) for value in (rotation, center, points)]
    jacobian = torch.func.jacfwd(lambda change: bearing(change, *fixed))(torch.zeros(6, dtype=torch.float64))
    return torch.einsum("nki,nkj->ij", jacobian, jacobian).numpy()


@pytest.mark.parametrize("seed", range(5))
def test_information_is_that_of_automatic_differentiation(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    center = rng.normal(scale=4, size=3)
    points = center + rng.normal(size=(30, 3)) * rng.uniform(0.1, 10, (30, 1))
    numbers = bearing_numbers(points - center).sum(0)
    for bearing, pivot in ((bearing_about_camera, None), (bearing_about_origin, -center)):
        expected = differentiated(bearing, rotation, center, points)
        error = np.abs(information_matrices(numbers, pivot) - expected).max() / np.abs(expected).max()
        assert error < 1e-12
    assert np.abs(information_matrices(numbers) - expected).max() > 0.1 * np.abs(expected).max()  # they are two things


def test_the_trace_of_one_landmark_in_closed_form():
    offsets = np.random.default_rng(0).normal(size=(50, 3)) * 3
    expected = 2 / np.linalg.norm(offsets, axis=1) ** 2 + 2
    np.testing.assert_allclose(metric_of(bearing_numbers(offsets), "trace"), expected)
    np.testing.assert_allclose(bearing_numbers(offsets) @ TRACE, expected)


def kinds_of_numbers():
    rng = np.random.default_rng(0)
    landmarks = bearing_numbers(rng.normal(size=(300, 40, 3)) * rng.uniform(0.05, 20, (300, 40, 1)))
    sphere = np.zeros((3, 15))
    sphere[:, [0, 3, 5]] = 2.0  # eigenvalues that are the same
    sphere[:, [9, 12, 14]] = [[2.0], [5.0], [-2.0]]
    return {
        "many landmarks": landmarks.sum(1),
        "indefinite": (landmarks[:, :20].sum(1) - 0.7 * landmarks[:, 20:].sum(1)),
        "any": rng.normal(size=(300, 15)) * 10.0 ** rng.integers(-6, 7, (300, 1)),
        "none": np.zeros((3, 15)),
        "one landmark": landmarks[:, 0],
        "two landmarks": landmarks[:, :2].sum(1),
        "near and far": bearing_numbers(rng.normal(size=(50, 30, 3)) * 10.0 ** rng.uniform(-3, 3, (50, 30, 1))).sum(1),
        "equal eigenvalues": sphere,
    }


@pytest.mark.parametrize("kind", kinds_of_numbers())
@pytest.mark.parametrize("pivoted", [False, True])
def test_eigenvalues_and_metrics_are_numpys(kind, pivoted, device):
    numbers = kinds_of_numbers()[kind]
    pivots = np.random.default_rng(1).normal(scale=3, size=(len(numbers), 3)) if pivoted else None
    values = eigenvalues(numbers, pivots, device)
    plain = eigenvalues_plain(numbers, pivots)
    assert np.all(np.abs(np.sort(values, axis=1) - plain) <= 2e-14 * np.abs(plain).max(1, keepdims=True))
    matrices = information_matrices(numbers, pivots)
    norm = np.linalg.norm(matrices, axis=(1, 2))
    singular = np.linalg.svd(matrices, compute_uv=False)[:, -1]
    assert np.all(np.abs(metric_of_eigenvalues(values, "mineig") - singular) <= 1e-12 * norm)
    trace = np.einsum("bii->b", matrices)
    assert np.all(np.abs(metric_of_eigenvalues(values, "trace") - trace) <= 1e-12 * norm)
    determinant = np.linalg.det(matrices)
    expected = np.sign(determinant) * np.log1p(np.abs(determinant))
    sure = singular > 1e-5 * norm  # where the determinant itself is known to some ten digits
    found = metric_of_eigenvalues(values, "logdet")
    np.testing.assert_allclose(found[sure], expected[sure], rtol=1e-9)
    assert sure.any() != (kind in ("none", "one landmark", "two landmarks"))
    assert np.any(found < -0.1) == (kind in ("indefinite", "any", "equal eigenvalues"))
