"""Moving pictures as files: animated WebP or GIF, which browsers and READMEs show, or MP4."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError, StorageError
from wheretolook.utils.files import STORAGE_FIX, atomic_write

Pixels = NDArray[np.uint8]  # an image (H, W, 3), or several (N, H, W, 3)

QUALITY = 55  # of WebP, of 100


def pixels_of(figure: Figure) -> Pixels:
    """A figure as an image (H, W, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_moving(frames: Iterable[Pixels], times_ms: int | Sequence[int], path: Path) -> None:
    """Write frames (H, W, 3), at least one and all of one size, as .webp, .gif or .mp4 by the file's ending; in one
    step.

    `times_ms` tells for how many milliseconds a frame stands: all of them, or each. Raises ConfigError for another
    ending, or if MP4 cannot be written here.
    """
    if path.suffix not in (".webp", ".gif", ".mp4"):
        raise ConfigError("a film is a .webp, a .gif or an .mp4", path=path, value=path.suffix, fix="Name it so.")
    with atomic_write(path, path.with_name(f".partial-{path.name}")) as partial:
        if path.suffix == ".mp4":
            _save_mp4(frames, times_ms, partial, path)
        else:
            _save_animation(frames, times_ms, partial)


def _save_animation(frames: Iterable[Pixels], times_ms: int | Sequence[int], partial: Path) -> None:
    from PIL import Image

    images = (Image.fromarray(frame) for frame in frames)
    more: dict[str, Any] = {"quality": QUALITY, "method": 6}
    if partial.suffix == ".gif":
        images = (image.quantize(128) for image in images)
        more = {}
    first, *rest = images
    times = times_ms if isinstance(times_ms, int) else list(times_ms)
    first.save(partial, save_all=True, append_images=rest, duration=times, loop=0, **more)


def _save_mp4(frames: Iterable[Pixels], times_ms: int | Sequence[int], partial: Path, path: Path) -> None:
    """Write the file `partial` of the film that is to be `path`. Raises as `save_moving`."""
    import cv2

    partial.write_bytes(b"")  # OpenCV does not tell why it cannot open a file
    step_ms, times = (times_ms, repeat(times_ms)) if isinstance(times_ms, int) else (gcd(*times_ms), times_ms)
    writer = None
    n_frames = 0
    for frame, time_ms in zip(frames, times, strict=False):  # all of an MP4 stand equally long: some are repeated
        even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]  # the codec needs even sides
        if writer is None:
            codec = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(str(partial), codec, 1000 / step_ms, even.shape[1::-1])
            if not writer.isOpened():
                raise ConfigError("this OpenCV cannot write MP4", path=path, fix="Ask for a .gif.")
        for _ in range(time_ms // step_ms):
            writer.write(np.ascontiguousarray(even[..., ::-1]))
            n_frames += 1
    if writer is not None:
        writer.release()
        written = cv2.VideoCapture(str(partial))  # OpenCV does not notice a full disk
        whole = written.get(cv2.CAP_PROP_FRAME_COUNT) == n_frames
        written.release()
        if not whole:
            raise StorageError("cannot be written whole: is the disk full?", path=path, fix=STORAGE_FIX)
