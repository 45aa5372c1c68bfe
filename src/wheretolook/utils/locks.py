"""Locks on folders and stores, held by one process or shared by readers. The system releases those of ended processes."""

from __future__ import annotations

import errno
import os
import socket
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wheretolook.utils.errors import InUseError, LockWarning
from wheretolook.utils.files import missing_folders, remove_if_empty
from wheretolook.utils.processes import OPEN_LOCK, lock_file

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
_NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOSPC)


@contextmanager
def hold(lock: Path, what: str, *, shared: bool = False, wait_s: float = 0.0) -> Iterator[None]:
    """Hold a lock on a file within this block; the file is created if missing and removed at the end,
    as are folders that were created for it and are empty then.

    Where nothing can be written, as in a read-only folder, the block runs without a lock; where the file system has no
    locks, a warning is issued. A lock does not nest.

    Args:
        lock: path of the lock file. Its folder is created unless `shared`.
        what: the purpose, shown to processes that find the lock held, such as "label".
        shared: share the lock with other readers.
        wait_s: seconds to wait for others.

    Raises:
        InUseError: another process holds it. OSError: the file cannot be made.
    """
    created = missing_folders(lock)
    deadline = time.monotonic() + wait_s
    file = _try_lock(lock, shared)
    while file == _HELD and time.monotonic() < deadline:
        time.sleep(0.05)
        file = _try_lock(lock, shared)
    if file == _HELD:
        holder = ""
        with suppress(OSError):
            holder = lock.read_text(errors="replace")[:200]
        fix = "Wait until it has ended, or end it, and run again."
        raise InUseError("another process is using this", path=lock, value=holder, fix=fix)
    if file is None:
        yield
        return
    try:
        with suppress(OSError):  # such as a full disk
            os.ftruncate(file, 0)
            os.lseek(file, 0, os.SEEK_SET)
            os.write(file, f"{what}, process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        with suppress(OSError):
            lock_file(file, shared=False)  # only the last reader can and removes the file
            if _is_current(lock, file):
                lock.unlink()
                remove_if_empty(created)
        os.close(file)
        if sys.platform == "win32":  # which removes no open file, so that the last to close it can
            with suppress(OSError):
                lock.unlink()
                remove_if_empty(created)


_HELD = -1


def _try_lock(lock: Path, shared: bool) -> int | None:
    """Open and lock the file. Returns its descriptor, `_HELD` if others hold it, or None if locking is impossible."""
    try:
        if not shared:
            lock.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(lock, OPEN_LOCK, 0o666)
    except OSError as error:
        if error.errno in _NOT_WRITABLE:
            return None
        raise
    try:
        lock_file(file, shared)
    except BlockingIOError:
        os.close(file)
        return _HELD
    except OSError as error:
        os.close(file)
        if error.errno not in _NO_LOCKS:
            raise
        text = f"{lock.parent}: this file system has no locks; make sure that only one process writes at a time"
        warnings.warn(text, LockWarning, stacklevel=4)
        return None
    if _is_current(lock, file):
        return file
    os.close(file)  # the last holder removed it while this process opened it
    return _try_lock(lock, shared)


def _is_current(lock: Path, file: int) -> bool:
    """Return whether the path still leads to the open file."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.stat(lock, follow_symlinks=False), os.fstat(file))
    return False
