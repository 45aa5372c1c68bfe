"""What depends on the operating system: cores, locks of files, signals to the main thread, the end of the parent."""

from __future__ import annotations

import _thread
import ctypes
import os
import signal
import threading
from contextlib import suppress

READERS = 64  # that can share a lock on Windows
_LOCKED = 2**20  # offset of the locked bytes, beyond the content of any lock file
_PR_SET_PDEATHSIG = 1  # sys/prctl.h

OPEN_LOCK = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Flags for opening a lock file: not through a link, and without waiting for the other end of a pipe."""


def cores() -> int:
    """Return the number of CPU cores that this process may use; all of them where the system has no such limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def lock_file(file: int, shared: bool) -> None:
    """Lock an open file for this process, or for it and other readers. The system releases locks of ended processes.

    Raises BlockingIOError if others hold it, OSError if the file system has no locks.
    """
    try:
        import fcntl
    except ImportError:
        _lock_bytes(file, shared)
    else:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def _lock_bytes(file: int, shared: bool) -> None:
    """Lock on Windows, where each byte has one holder: a reader locks one of `READERS` bytes, a writer all."""
    import msvcrt

    for reader in range(READERS if shared else 1):
        os.lseek(file, _LOCKED + reader, os.SEEK_SET)
        with suppress(PermissionError):
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1 if shared else READERS)  # type: ignore[attr-defined]
            return
    raise BlockingIOError


def signal_main_thread(number: int) -> None:
    """Send a signal to the main thread, which wakes it from system calls (not on Windows)."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        _thread.interrupt_main(signal.Signals(number))


def hold_back(number: int, held: bool) -> None:
    """Hold a signal back from this thread, or release it; on Windows signals are not held back."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK if held else signal.SIG_UNBLOCK, [number])


def end_with_starting_thread() -> None:
    """Let Linux kill this process when the thread that started it ends, whatever this process does (prctl(2))."""
    with suppress(OSError, AttributeError, TypeError):  # TypeError: Windows has no library without a name
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
