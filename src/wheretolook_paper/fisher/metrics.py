"""Scalar metrics of the information on a pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from wheretolook.geometry.pose_information import N_NUMBERS
from wheretolook.geometry.poses import Float
from wheretolook.utils.warp import start_warp
from wheretolook_paper.fisher import metrics_kernel
from wheretolook_paper.fisher.exact import run_in_parts
from wheretolook_paper.fisher.metrics_kernel import eigenvalues_kernel

TRACE = np.zeros(N_NUMBERS)  # weights (15,) whose product with the numbers of a matrix is its trace
TRACE[[0, 3, 5, 9, 12, 14]] = 1
METRICS = ("mineig", "logdet", "trace")


def metric_of(numbers: ArrayLike, metric: str, device: str = "cpu") -> Float:
    """Return a metric (B,) of information matrices (B, 15) about the camera; more is better.

    The metric is "trace"; "logdet", the logarithm of one plus the determinant (log(1 + d), and -log(1 - d) where an
    approximation makes d negative), so that it is finite without landmarks and keeps the determinant's order; or
    "mineig", the smallest absolute eigenvalue, the singular value that the released code takes.
    """
    if metric == "trace":
        return np.asarray(np.asarray(numbers, dtype=np.float64) @ TRACE)
    return metric_of_eigenvalues(eigenvalues(numbers, None, device), metric)


def metric_of_eigenvalues(values: Float, metric: str) -> Float:
    """Return a metric (B,) of eigenvalues (B, 6), see `metric_of`."""
    if metric == "trace":
        return np.asarray(values.sum(-1))
    if metric == "mineig":
        return np.asarray(np.abs(values).min(-1))
    with np.errstate(divide="ignore"):
        log_of_absolute = np.log(np.abs(values)).sum(-1)
    return np.asarray(np.sign(values).prod(-1) * np.logaddexp(0, log_of_absolute))


def eigenvalues(numbers: ArrayLike, pivots: ArrayLike | None = None, device: str = "cpu") -> Float:
    """Return unordered eigenvalues (B, 6) of information matrices (B, 15), with errors of about 1e-16 of the norm.

    The matrices are about pivots (B, 3) as in `information_matrices`, or about the camera.
    """
    numbers = np.ascontiguousarray(numbers, dtype=np.float64).reshape(-1, N_NUMBERS)
    arms = np.empty((0, 3)) if pivots is None else np.ascontiguousarray(pivots, dtype=np.float64).reshape(-1, 3)
    device = start_warp(device)
    values = np.empty((len(numbers), 6))

    def work(part: slice) -> None:
        there: Any = wp.array(numbers[part], dtype=wp.float64, device=device)
        about: Any = wp.array(arms[part], dtype=wp.vec3d, device=device)
        found: Any = wp.empty((part.stop - part.start, 6), dtype=wp.float64, device=device)
        inputs = [there, pivots is not None, about]
        wp.launch(eigenvalues_kernel, found.shape[0], inputs, [found], device=device)
        values[part] = found.numpy()

    wp.load_module(metrics_kernel, device=device)  # only one thread may do that
    # 4,096 matrices are a few milliseconds of work of a CPU thread
    run_in_parts(len(numbers), 4096 if device == "cpu" else max(1, len(numbers)), work, device)
    return values
