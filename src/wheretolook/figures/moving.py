"""Moving pictures as files that browsers and READMEs show: animated WebP or GIF."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import replacing

QUALITY = 55  # of WebP, of 100


def pixels_of(figure: Figure) -> NDArray[np.uint8]:
    """A figure as an image (H, W, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_moving(frames: Iterable[NDArray[np.uint8]], times_ms: Sequence[int], path: Path) -> None:
    """Write frames (H, W, 3), each standing for its time, as .webp or .gif by the file's ending; in one step.

    Raises ConfigError for another ending.
    """
    from PIL import Image

    if path.suffix not in (".gif", ".webp"):
        raise ConfigError("a moving picture is a .webp or a .gif", path=path, value=path.suffix, fix="Name it so.")
    images = [Image.fromarray(frame) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path, path.with_name(f".partial-{path.name}")) as partial:
        if path.suffix == ".gif":
            images = [image.quantize(128) for image in images]
        more: dict[str, Any] = {"quality": QUALITY, "method": 6} if path.suffix == ".webp" else {}
        images[0].save(partial, save_all=True, append_images=images[1:], duration=list(times_ms), loop=0, **more)
