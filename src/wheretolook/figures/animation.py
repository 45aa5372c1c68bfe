"""Write animated WebP, GIF and MP4 files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat
from math import gcd
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError, StorageError
from wheretolook.utils.files import STORAGE_FIX, atomic_write

Pixels = NDArray[np.uint8]  # an image (H, W, 3) or several (N, H, W, 3)

WEBP_QUALITY = 55  # of 100
GIF_COLORS = 128


def pixels_of(figure: Figure) -> Pixels:
    """Render a figure to an image (H, W, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_moving(frames: Iterable[Pixels], times_ms: int | Sequence[int], path: Path) -> None:
    """Write frames (H, W, 3) of equal size, at least one, as .webp, .gif or .mp4, atomically.

    `times_ms` is the duration of every frame, or one duration per frame. Raises ConfigError for another file name
    suffix or if OpenCV cannot write MP4.
    """
    if path.suffix not in (".webp", ".gif", ".mp4"):
        raise ConfigError("unsupported film format", path=path, fix="Use .webp, .gif or .mp4.")
    with atomic_write(path, path.with_name(f".partial-{path.name}")) as partial:
        if path.suffix == ".mp4":
            _save_mp4(frames, times_ms, partial, path)
        else:
            _save_animation(frames, times_ms, partial)


def _save_animation(frames: Iterable[Pixels], times_ms: int | Sequence[int], partial: Path) -> None:
    from PIL import Image

    images = (Image.fromarray(frame) for frame in frames)
    times = times_ms if isinstance(times_ms, int) else list(times_ms)
    if partial.suffix == ".gif":
        first, *rest = (image.quantize(GIF_COLORS) for image in images)
        first.save(partial, save_all=True, append_images=rest, duration=times, loop=0)
    else:
        first, *rest = images
        first.save(partial, save_all=True, append_images=rest, duration=times, loop=0, quality=WEBP_QUALITY, method=6)


def _save_mp4(frames: Iterable[Pixels], times_ms: int | Sequence[int], partial: Path, path: Path) -> None:
    """Write the temporary file `partial` of the film `path`."""
    import cv2

    partial.write_bytes(b"")  # raises with the cause if the file cannot be written; OpenCV would not
    step_ms, times = (times_ms, repeat(times_ms)) if isinstance(times_ms, int) else (gcd(*times_ms), times_ms)
    writer = None
    n_frames = 0
    for frame, time_ms in zip(frames, times, strict=False):
        even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]  # the codec needs even sides
        if writer is None:
            codec = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(str(partial), codec, 1000 / step_ms, even.shape[1::-1])
            if not writer.isOpened():
                raise ConfigError("this OpenCV build cannot write MP4", path=path, fix="Use .gif.")
        for _ in range(time_ms // step_ms):  # the frame rate is constant: longer frames are repeated
            writer.write(np.ascontiguousarray(even[..., ::-1]))
            n_frames += 1
    if writer is not None:
        writer.release()
        written = cv2.VideoCapture(str(partial))  # OpenCV does not report a full disk
        complete = written.get(cv2.CAP_PROP_FRAME_COUNT) == n_frames
        written.release()
        if not complete:
            raise StorageError("the film is incomplete; is the disk full?", path=path, fix=STORAGE_FIX)
