"""Write animated WebP, GIF and MP4 files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import atomic_write

Pixels = NDArray[np.uint8]  # an image (H, W, 3)


def pixels_of(figure: Figure) -> Pixels:
    """Render a figure to an image (H, W, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def save_moving(frames: Iterable[Pixels], frame_ms: int, path: Path, last_ms: int | None = None) -> None:
    """Write frames (H, W, 3) of equal size, at least one, as .webp, .gif or .mp4, atomically.

    Each frame is shown for `frame_ms`, the last one for `last_ms`. Raises ConfigError for another file name suffix or
    if OpenCV cannot write MP4.
    """
    if path.suffix not in (".webp", ".gif", ".mp4"):
        raise ConfigError("unsupported film format", path=path, fix="Use .webp, .gif or .mp4.")
    with atomic_write(path, path.with_name(f".partial-{path.name}")) as partial:
        save = _save_mp4 if path.suffix == ".mp4" else _save_animation
        save(frames, frame_ms, last_ms or frame_ms, partial)


def _save_animation(frames: Iterable[Pixels], frame_ms: int, last_ms: int, partial: Path) -> None:
    from PIL import Image

    is_gif = partial.suffix == ".gif"
    images = (Image.fromarray(frame) for frame in frames)
    first, *rest = (image.quantize(128) if is_gif else image for image in images)
    times = [frame_ms] * len(rest) + [last_ms]
    options: dict[str, Any] = {} if is_gif else {"quality": 55, "method": 6}
    first.save(partial, save_all=True, append_images=rest, duration=times, loop=0, **options)


def _save_mp4(frames: Iterable[Pixels], frame_ms: int, last_ms: int, partial: Path) -> None:
    import cv2

    partial.write_bytes(b"")  # raises with the cause if the file cannot be written; OpenCV would not
    writer = None
    n_frames = 0
    for frame in frames:
        even = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]  # the codec needs even sides
        if writer is None:
            codec = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(str(partial), codec, 1000 / frame_ms, even.shape[1::-1])
            if not writer.isOpened():
                raise ConfigError("this OpenCV build cannot write MP4", fix="Use .gif.")
        bgr = np.ascontiguousarray(even[..., ::-1])
        writer.write(bgr)
        n_frames += 1
    assert writer is not None
    for _ in range(last_ms // frame_ms - 1):  # the frame rate is constant
        writer.write(bgr)
        n_frames += 1
    writer.release()
    written = cv2.VideoCapture(str(partial))  # OpenCV does not report a full disk
    complete = written.get(cv2.CAP_PROP_FRAME_COUNT) == n_frames
    written.release()
    if not complete:
        raise OSError("the film is incomplete; is the disk full?")
