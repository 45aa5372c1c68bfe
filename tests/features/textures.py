"""Images of random texture."""

import numpy as np
from scipy.ndimage import gaussian_filter


def texture(seed, rows=240, columns=320):
    """Make a grey image (rows, columns) with structure of several sizes."""
    rng = np.random.default_rng(seed)
    image = sum(2 * s * gaussian_filter(rng.normal(0, 30, (rows, columns)), s) for s in (0.7, 1.5, 4, 10))
    return np.clip(128 + image, 0, 255).astype(np.uint8)


def color_texture(seed, rows=240, columns=320):
    """Make a colour image (rows, columns, 3) of three such textures."""
    return np.stack([texture(3 * seed + channel, rows, columns) for channel in range(3)], axis=2)
