"""Worker processes that leave Ctrl-C to their parent, do not outlive it, and hold on to their memory."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess


@contextmanager
def spawning() -> Iterator[None]:
    """While processes are spawned: they inherit that SIGINT is ignored, from their first moment on.

    A worker that sets this itself does so only after its imports, which take seconds.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def end_with_parent() -> None:
    """Called in a worker: end it when its parent ends, even if the parent was killed and could not end it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait_and_exit, args=(parent,), daemon=True).start()


def use_one_core() -> None:
    """Called in a worker that runs SIFT beside others, one for each core: OpenCV keeps to one thread and its memory."""
    import cv2

    cv2.setNumThreads(1)
    _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Let the C library reuse memory that was freed instead of giving it back to the system.

    SIFT takes and frees about 70 MB for each 640 x 480 image; getting it back page by page took a third of its time.
    """
    try:
        library = ctypes.CDLL("libc.so.6")
        library.mallopt(_M_MMAP_THRESHOLD, 32 * 2**20)  # the most that glibc allows
        library.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    except (OSError, AttributeError):  # another C library
        pass


_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of malloc.h


def _wait_and_exit(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
