"""Soft visibility of landmarks, a product of a function of the camera's axis and one of the landmark.

Zhang and Scaramuzza, Fisher Information Field, 2020, Sec. V: the visibility v of a landmark from a camera with the
optical axis z is taken to depend only on the angle between z and the landmark's bearing f, and approximated by
v(z, f) = a(z) . b(f) with F factors. Sums over landmarks of (information x b) can then be stored for a location; their
product with a(z) is the information in any direction.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import minimize_scalar

from wheretolook.geometry.camera import Camera, ColmapCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float

JITTER = 1e-10  # added to the diagonal of a Gaussian process's K


class SoftVisibility(ABC):
    """v(z, f) = a(z) . b(f)."""

    n_factors: int

    @abstractmethod
    def of_axes(self, axes: Float) -> Float:
        """Return a(z) (D, F) of unit optical axes (D, 3)."""

    @abstractmethod
    def of_bearings(self, bearings: Float) -> Float:
        """Return the summand (N, F) of landmarks with unit bearings (N, 3): b(f), after `finish`."""

    def finish(self, sums: Float) -> Float:
        """Turn sums (..., F, K) over `of_bearings` into sums over b(f): linear, so it can be applied at the end."""
        return sums


@dataclass(frozen=True)
class QuadraticVisibility(SoftVisibility):
    """v = k1 c^2 + k2 c + k3, with the cosine c between axis and bearing: 10 factors.

    Args:
        half_angle_rad: of the cone that stands for the field of view.
        boundary: v at the cone's edge.
        boundary_to_mid: v at the cone's edge as a share of v straight ahead. 0.8, as in the Fisher field's experiment
            on orientations. (Its library's default is 0.5, for which v falls to -0.33 next to the camera. Then sums are
            indefinite, and log det and min. eigenvalue choose worse views on the validation scene.)
    """

    half_angle_rad: float
    boundary: float = 0.8
    boundary_to_mid: float = 0.8
    n_factors = 10

    @cached_property
    def coefficients(self) -> tuple[float, float, float]:
        """k1, k2, k3: v(-1) = 0, v(cos half angle) = boundary, v(1) = boundary / boundary_to_mid."""
        cosine = np.cos(self.half_angle_rad)
        rows = [[1, -1, 1], [cosine**2, cosine, 1], [1, 1, 1]]
        k1, k2, k3 = np.linalg.solve(rows, [0, self.boundary, self.boundary / self.boundary_to_mid])
        return float(k1), float(k2), float(k3)

    def of_axes(self, axes: Float) -> Float:
        """Return a(z), (D, 10)."""
        k1, k2, k3 = self.coefficients
        weights = np.array([k1, 2 * k1, 2 * k1, k1, 2 * k1, k1, k2, k2, k2, k3])  # mixed products come twice in c^2
        return np.asarray(self.of_bearings(axes) * weights)

    def of_bearings(self, bearings: Float) -> Float:
        """Return b(f), (N, 10): xx, xy, xz, yy, yz, zz, the bearing, one."""
        x, y, z = bearings.T
        return np.stack([x * x, x * y, x * z, y * y, y * z, z * z, x, y, z, np.ones_like(x)], axis=-1)


@dataclass(frozen=True)
class GaussianProcessVisibility(SoftVisibility):
    """v interpolated by a Gaussian process from F sampled axes, at which it is a soft step at the edge of the cone.

    v(z, f) = k(z, Z) K^-1 s(Z . f) with the sampled axes Z, the kernel k(z, z') = exp(-|z - z'|^2 / 2 l^2),
    K = k(Z, Z), and s(c) = 1 / (1 + exp(-steepness (c - cos half angle))).
    """

    half_angle_rad: float  # of the cone that stands for the field of view
    length: float  # l, the length of a chord of the unit sphere
    n_factors: int = 70  # F; the axes are a Fibonacci lattice
    steepness: float = 15.0  # of the soft step

    @classmethod
    @lru_cache
    def fitted(cls, half_angle_rad: float, n_factors: int = 70) -> GaussianProcessVisibility:
        """Return the process whose length l maximizes the marginal likelihood of the step at the axes, for many bearings."""
        bearings = np.random.default_rng(0).normal(size=(1000, 3))
        bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)

        def negative_log_likelihood(log_length: float) -> float:
            process = cls(half_angle_rad, float(np.exp(log_length)), n_factors)
            kernel = process.of_axes(process.axes) + JITTER * np.eye(n_factors)
            seen = process.step(process.axes @ bearings.T)  # (F, 1000)
            sign, log_determinant = np.linalg.slogdet(kernel)
            if sign <= 0:
                return np.inf
            # the best variance of the kernel for this length, in closed form
            variance = float(np.mean(seen * np.linalg.solve(kernel, seen)))
            return float(np.inf if variance <= 0 else n_factors * np.log(variance) + log_determinant)

        found = minimize_scalar(negative_log_likelihood, bounds=np.log([0.05, 1.2]), method="bounded")
        return cls(half_angle_rad, float(np.exp(found.x)), n_factors)

    @cached_property
    def axes(self) -> Float:
        """Z, (F, 3)."""
        return fibonacci_sphere(self.n_factors)

    @cached_property
    def inverse(self) -> Float:
        """K^-1, (F, F)."""
        return np.asarray(np.linalg.inv(self.of_axes(self.axes) + JITTER * np.eye(self.n_factors)))

    def of_axes(self, axes: Float) -> Float:
        """Return k(z, Z), (D, F)."""
        return np.asarray(np.exp((axes @ self.axes.T - 1) / self.length**2))  # |z - z'|^2 = 2 - 2 z . z'

    def of_bearings(self, bearings: Float) -> Float:
        """Return s(Z . f), (N, F); `finish` multiplies by K^-1."""
        return self.step(bearings @ self.axes.T)

    def finish(self, sums: Float) -> Float:
        """Return K^-1 times sums (..., F, K)."""
        return np.asarray(self.inverse @ sums)

    def step(self, cosines: Float) -> Float:
        """Return s(c) of cosines between axis and bearing."""
        return np.asarray(0.5 * (1 + np.tanh(0.5 * self.steepness * (cosines - np.cos(self.half_angle_rad)))))


def cone_half_angle(camera: Camera) -> float:
    """Return half the opening angle in radians of the cone with the solid angle of a camera's field of view."""
    if isinstance(camera, ColmapCamera):
        directions = fibonacci_sphere(20_000)
        share = float(np.mean(camera.sees(directions)))
        return float(np.arccos(np.clip(1 - 2 * share, -1, 1)))
    a = np.array([camera.cx, camera.width - camera.cx]) / camera.fx
    b = np.array([[camera.cy], [camera.height - camera.cy]]) / camera.fy
    # the image's four quarters about the principal point
    solid_angle = np.sum(np.arcsin(a * b / np.sqrt((1 + a * a) * (1 + b * b))))
    return float(np.arccos(1 - solid_angle / (2 * np.pi)))
