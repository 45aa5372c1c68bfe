"""Worker processes that ignore Ctrl-C, end with their parent, and reuse freed memory."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.process import BaseProcess


@contextmanager
def spawning() -> Iterator[None]:
    """Processes spawned within this block ignore SIGINT from the start.

    If workers set this themselves, a Ctrl-C during their imports, which take seconds, would still reach them.
    """
    if not in_main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def in_main_thread() -> bool:
    """Whether this is the main thread, which lives as long as its process."""
    return threading.current_thread() is threading.main_thread()


def end_with_parent(of_main_thread: bool) -> None:
    """Called in a worker: end it when its parent ends, even if the parent is killed.

    On Linux the kernel ends it at once, even in the middle of a compiled function that lets no other thread run: what a
    killed run has begun must write nothing beside the next run. Elsewhere a thread does. So it is, too, if the worker
    was not started by its parent's main thread: the kernel ends it with the thread that started it (prctl(2)).
    """
    if of_main_thread:
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait_and_exit, args=(parent,), daemon=True).start()


def use_one_core() -> None:
    """Called in a worker that runs SIFT, one for each core: OpenCV uses one thread and reuses freed memory."""
    import cv2

    cv2.setNumThreads(1)
    _keep_freed_memory()


def _keep_freed_memory() -> None:
    """Let the C library reuse freed memory instead of returning it to the system.

    SIFT allocates about 70 MB for each 640 x 480 image; getting it from the system each time took a third of its time.
    """
    try:
        library = ctypes.CDLL("libc.so.6")
        library.mallopt(_M_MMAP_THRESHOLD, 32 * 2**20)  # the most that glibc allows
        library.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    except (OSError, AttributeError):  # another C library
        pass


_PR_SET_PDEATHSIG = 1  # of sys/prctl.h
_M_TRIM_THRESHOLD = -1  # of malloc.h
_M_MMAP_THRESHOLD = -3


def _wait_and_exit(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
