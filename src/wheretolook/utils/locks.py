"""Locks on folders and stores, held by one run, or by several that only read. The kernel releases those of the dead."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import stat
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from wheretolook.utils.errors import InUseError, LockWarning


@contextmanager
def hold(lock: Path, what: str, *, shared: bool = False, wait_s: float = 0.0) -> Iterator[None]:
    """Hold a lock within this block. A second run stops at once, or waits, and says who holds it.

    The lock is on a file, which is made if need be, says who holds it, and is removed in the end. A process that is
    killed leaves the file behind, but no lock on it: the kernel releases that (flock(2)). Processes that the holder
    starts do not hold it, so one that outlives the holder blocks nobody: it must end by itself, and write nothing.

    Where the file system has no locks, a warning says so and the work goes on; likewise where nothing can be written,
    as in a folder that one may only read, but without a warning. A lock does not nest: whoever holds it waits in vain.

    Args:
        lock: path of the lock file, in a folder that is there if `shared`, and made otherwise.
        what: who holds it, for others to read, such as "label".
        shared: hold it beside others that share it, and beside none that does not: for those who only read.
        wait_s: how many seconds to wait for others.

    Raises:
        InUseError: others hold it. OSError: the file cannot be made.
    """
    deadline = time.monotonic() + wait_s
    while (file := _locked(lock, shared)) is _TAKEN:
        if time.monotonic() >= deadline:
            who = _holders(lock)
            fix = "Wait until it has ended, or end it, and run again."
            raise InUseError("another run is at work here", path=lock, value=who, fix=fix)
        time.sleep(0.05)
    if file is None:
        yield
        return
    _held.add(file)
    try:
        _sign(file, what, shared)
        yield
    finally:
        if file in _held:  # else this is a forked child, whose copy was closed
            _held.remove(file)
            _release(lock, file)


_TAKEN = -1
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
_NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS)
_held: set[int] = set()


def _locked(lock: Path, shared: bool) -> int | None:
    """A descriptor of the locked file; None where nothing can be locked, `_TAKEN` if others hold it."""
    while True:
        file = _opened(lock, shared)
        if file is None:
            return None
        try:
            if not stat.S_ISREG(os.fstat(file).st_mode):
                raise OSError(errno.EINVAL, "a lock must be a regular file", str(lock))
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            if _is_at(lock, file):
                return file
            os.close(file)  # the last holder removed it while this run was opening it
        except BlockingIOError:
            os.close(file)
            return _TAKEN
        except OSError as error:
            os.close(file)
            if error.filename is not None or error.errno not in _NO_LOCKS:
                raise
            lock.unlink(missing_ok=True)
            text = f"{lock.parent}: this file system has no locks, so see to it yourself that one run at a time writes"
            warnings.warn(text, LockWarning, stacklevel=4)
            return None


def _opened(lock: Path, shared: bool) -> int | None:
    safe = os.O_NOFOLLOW | os.O_NONBLOCK  # a link would lead elsewhere, a pipe would wait
    try:
        if not shared:
            lock.parent.mkdir(parents=True, exist_ok=True)
        return os.open(lock, os.O_RDWR | os.O_CREAT | safe, 0o666)
    except OSError as error:
        if error.errno not in _NOT_WRITABLE and not (shared and error.errno in (errno.ENOENT, errno.ENOSPC)):
            raise
    try:
        return os.open(lock, os.O_RDONLY | safe)
    except OSError:  # nothing can be written here, or there is nothing to read
        return None


def _sign(file: int, what: str, shared: bool) -> None:
    """Write a line that says who holds the lock; a full disk is no reason not to work."""
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]) if sys.argv else ""
    now = datetime.now().isoformat(" ", "seconds")
    line = "\t".join((str(os.getpid()), socket.gethostname(), now, what, " ".join(command.split())[:200])) + "\n"
    with suppress(OSError):
        if not shared:
            os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_END)
        os.write(file, line.encode(errors="replace"))


def _holders(lock: Path) -> str:
    """Who holds a lock, as the file says, without those that were killed."""
    found = []
    with suppress(OSError):
        file = os.open(lock, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            text = os.read(file, 2**16).decode(errors="replace")
        finally:
            os.close(file)
        for line in text.splitlines():
            pid, host, since, what, command = (*line.split("\t"), "", "", "", "", "")[:5]
            if pid.isdecimal() and not (host == socket.gethostname() and _is_dead(int(pid))):
                found.append(f"{what}, process {pid} on {host} since {since}: {command}")
    return "; ".join(found[:4]) or "unknown"


def _is_dead(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except PermissionError:
        pass
    return False


def _is_at(lock: Path, file: int) -> bool:
    try:
        return os.path.samestat(os.stat(lock, follow_symlinks=False), os.fstat(file))
    except FileNotFoundError:
        return False


def _release(lock: Path, file: int) -> None:
    """Let go; the last one removes the file, which it alone holds then, so that nobody can lock what is removed."""
    try:
        _remove(lock, file)
    except KeyboardInterrupt:
        _remove(lock, file)
        raise
    finally:
        os.close(file)


def _remove(lock: Path, file: int) -> None:
    with suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if _is_at(lock, file):
            lock.unlink()


def _forget() -> None:
    """In a forked child: close its copies, or the locks would be held until it ends too."""
    for file in _held:
        os.close(file)
    _held.clear()


os.register_at_fork(after_in_child=_forget)
