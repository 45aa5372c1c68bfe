"""What a real camera, and people in front of it, do to a rendered image; drawn at random."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float

PERSON_M = (1.7, 0.5)
"""Height and width of an occluder in metres."""

READ_NOISE = 1 / 30
"""Standard deviation of noise in black, over that of shot noise in white."""

_LIGHT = np.array(
    [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in np.linspace(0, 1, 256)], np.float32
)
"""Linear light of the sRGB values 0 to 255 (IEC 61966-2-1)."""

_SRGB = np.searchsorted((_LIGHT[1:] + _LIGHT[:-1]) / 2, np.linspace(0, 1, 2**14)).astype(np.uint8)
"""Nearest sRGB values of 16,384 equal steps of linear light from 0 to 1."""


@dataclass(frozen=True)
class Appearance:
    """How an image differs from a rendering; of strength 0, nothing changes.

    Attributes:
        strength: what the parameters were drawn with, 0 to 1.
        gains: of red, green and blue in linear light: exposure times white balance.
        vignetting: exponent v of the falloff (1 + tan² a)^-v at the angle a from the optical axis; 2 is cos⁴ a.
        noise: standard deviation of shot noise in white, in linear light.
        rotation_deg: of the camera during the exposure: pitch and yaw. Blurs by as many pixels in the whole image as
            it moves the middle.
        defocus_deg: standard deviation of the Gaussian that a point becomes; half the radius of a disc.
        jpeg_quality: of the file; above 100 for none.
        occluders: number of upright boxes with the height and width of people, 1 to 4 m away, that stand on the floor if
            the camera is level and 1 to 1.7 m above it.
        seed: of noise, and of distances, positions and colours of occluders.
    """

    strength: float
    gains: tuple[float, ...]
    vignetting: float
    noise: float
    rotation_deg: tuple[float, ...]
    defocus_deg: float
    jpeg_quality: int
    occluders: int
    seed: int

    @classmethod
    def draw(cls, strength: float, rng: np.random.Generator) -> Appearance:
        """Draw parameters in proportion to a strength, 0 to 1; each of two occluders with half of it as probability."""
        exposure, red, blue, *rotation = strength * rng.uniform(-1, 1, 5)
        vignetting, noise, defocus, jpeg = strength * rng.random(4)
        return cls(
            strength=strength,
            gains=tuple(np.exp2(1.5 * exposure + 0.4 * np.array([red, 0, blue]))),
            vignetting=vignetting,
            noise=0.08 * noise,
            rotation_deg=tuple(0.7 * np.array(rotation)),
            defocus_deg=0.1 * defocus,
            jpeg_quality=round(101 - 71 * jpeg**2),  # most cameras use at least 80
            occluders=int((rng.random(2) < strength / 2).sum()),
            seed=int(rng.integers(2**32)),
        )

    @classmethod
    def of_views(cls, cam_from_world: Float, limit: float, seed: int) -> list[Appearance]:
        """Draw the appearances of views, each from a seed and its pose (3, 4) alone, at strengths from 0 to a limit.

        Poses count to six decimals, which compact tables keep.
        """
        keys = np.round(1e6 * cam_from_world.reshape(-1, 12)).astype(np.int64)
        rngs = [np.random.default_rng(np.array([seed, *key]).view(np.uint32)) for key in keys]
        return [cls.draw(limit * rng.random(), rng) for rng in rngs]

    def apply(self, rgb: NDArray[np.uint8], camera: Camera, depth_m: NDArray[Any] = np.zeros(())) -> NDArray[np.uint8]:
        """Return a camera's image (H, W, 3) sRGB with this appearance.

        Occluders hide what is further than they are, by z-depth (H, W) in metres with 0 where there is nothing.
        """
        rng = np.random.default_rng(self.seed)
        x, y = camera.principal_point
        pixels = np.ogrid[0.5 - y : camera.height - y, 0.5 - x : camera.width - x]
        down, right = (part / camera.mean_focal_px for part in pixels)  # tangents of the angles from the axis
        light = _LIGHT[rgb]
        for _ in range(self.occluders):
            _occlude(light, right, down, depth_m, rng)
        kernel = self.blur_kernel(camera.mean_focal_px)
        light = np.asarray(cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REPLICATE))
        light *= ((1 + right**2 + down**2) ** -self.vignetting)[..., None] * self.gains
        light += self.noise * np.sqrt(light + READ_NOISE**2) * rng.standard_normal(light.shape, dtype=np.float32)
        image = _SRGB[(light.clip(0, 1) * (len(_SRGB) - 1) + 0.5).astype(np.uint16)]
        if self.jpeg_quality > 100:
            return image
        file = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])[1]
        return np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), dtype=np.uint8)[..., ::-1]

    def blur_kernel(self, focal_px: float) -> NDArray[np.float32]:
        """Return the image (K, K), K odd, of a point of light 1: a Gaussian swept along a line."""
        rng = np.random.default_rng(self.seed)
        swept = rng.uniform(-0.5, 0.5, (4096, 1)) * self.rotation_deg
        spread = rng.normal(scale=self.defocus_deg, size=(4096, 2))
        points = np.round(focal_px * np.radians(swept + spread)).astype(int)
        half = abs(points).max()
        kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
        np.add.at(kernel, tuple(points.T + half), 1 / len(points))
        return kernel


def _occlude(
    light: NDArray[np.float32], right: Float, down: Float, depth_m: NDArray[Any], rng: np.random.Generator
) -> None:
    """Draw an occluder into an image, given the tangents of angles to the right (1, W) and down (H, 1)."""
    height, width = PERSON_M
    distance = 4 ** rng.random()
    rows = (down * distance - rng.uniform(1, height)) / height + 1
    columns = (right - rng.choice(right[0])) * distance / width + 0.5
    n_rows, n_columns = rng.choice(((1, 1), (9, 3), (170, 50)))  # of its shades: plain, checked or noise
    colors = rng.uniform(0.1, 1, (n_rows, n_columns, 1)) * rng.uniform(0.1, 0.5, 3)
    colors = colors[(rows * n_rows).astype(int) % n_rows, (columns * n_columns).astype(int) % n_columns]
    hidden = (abs(rows - 0.5) < 0.5) & (abs(columns - 0.5) < 0.5) & ((depth_m <= 0) | (depth_m > distance))
    light[hidden] = colors[hidden]
