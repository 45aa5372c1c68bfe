"""Worker processes and what depends on the operating system: cores, signals, locks on files."""

from __future__ import annotations

import _thread
import ctypes
import errno
import gc
import multiprocessing
import os
import signal
import socket
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, TypeVar

from wheretolook.utils.errors import InUseError, LockWarning, WorkerError
from wheretolook.utils.files import missing_folders, remove_if_empty


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
    """Lock on Windows, where each byte has one holder: a reader locks one of 64 bytes, a writer all."""
    import msvcrt

    for reader in range(64 if shared else 1):
        os.lseek(file, 2**20 + reader, os.SEEK_SET)  # beyond the content of any lock file
        with suppress(PermissionError):
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1 if shared else 64)  # type: ignore[attr-defined]
            return
    raise BlockingIOError


Item = TypeVar("Item")
Result = TypeVar("Result")


class WorkerPool:
    """Runs functions in `workers` spawned processes of one thread each; with one worker, `map` runs in this process.

    Processes start when first needed. They end with the block, at once if it raises.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._executor: ProcessPoolExecutor | None = None
        self._stop: Connection | None = None  # workers exit when it is closed

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._close(kill=kind is not None)

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """Apply a module-level function to items and yield results in their order, reading a few items ahead.

        Raises WorkerError if a process was killed.
        """
        if self.workers <= 1:
            yield from map(function, items)
            return
        source = iter(items)
        pending = deque[Future[Result]]()
        try:
            while True:
                for item in islice(source, 4 * self.workers - len(pending)):
                    pending.append(self._submit(function, item))
                if not pending:
                    return
                yield pending.popleft().result()
        except BrokenProcessPool as error:
            raise self._killed("a process was killed") from error
        finally:
            for future in pending:
                future.cancel()

    def map_unordered(
        self, function: Callable[[Item], Result], items: Iterable[Item], retries: int = 2
    ) -> Generator[tuple[Item, Result], None, None]:
        """Apply a module-level function to items in worker processes and yield items with results as they finish.

        If a process is killed, all unfinished items start again; after `retries` such restarts without a finished item
        between them, WorkerError is raised.
        """
        waiting = deque(items)
        running = dict[Future[Result], Item]()
        restarts = 0
        while waiting or running:
            try:
                while waiting and len(running) < 2 * self.workers:
                    future = self._submit(function, waiting[0])
                    running[future] = waiting.popleft()
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                results = [(future, future.result()) for future in done]
            except BrokenProcessPool as error:
                restarts += 1
                if restarts > retries:
                    raise self._killed(f"processes were killed {restarts} times at the same items") from error
                waiting.extendleft(reversed(running.values()))
                running.clear()
                self._close(kill=True)
                continue
            for future, result in results:
                restarts = 0
                yield running.pop(future), result

    def _submit(self, function: Callable[[Item], Result], item: Item) -> Future[Result]:
        if self._executor is None:
            context = multiprocessing.get_context("spawn")
            stopped, self._stop = context.Pipe(duplex=False)
            start = (stopped, in_main_thread())
            self._executor = ProcessPoolExecutor(self.workers, context, _start_worker, start)
        with ignoring_sigint():
            return self._executor.submit(function, item)

    def _close(self, kill: bool) -> None:
        if self._executor is None or self._stop is None:
            return
        if kill:
            self._stop.close()
        self._executor.shutdown(cancel_futures=True)
        self._stop.close()
        self._executor = None

    def _killed(self, problem: str) -> WorkerError:
        script = getattr(sys.modules["__main__"], "__file__", None)
        if script is not None and "__main__" not in Path(script).read_text(errors="replace"):
            fix = 'Put what the script does under `if __name__ == "__main__":`, or use one worker.'
            return WorkerError("worker processes import this script, which starts them again", path=script, fix=fix)
        fix = "Use fewer workers (--label.workers, or --workers) and run again; finished work is kept."
        return WorkerError(f"{problem}, probably for lack of memory", value=f"{self.workers} workers", fix=fix)


@contextmanager
def ignoring_sigint() -> Iterator[None]:
    """Let processes spawned in this block ignore SIGINT from their start, also during their imports."""
    if not in_main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def on_sigterm(handler: Any) -> None:
    """Set the handler of SIGTERM in the main thread, in place of COLMAP's own, which prints a native stack."""
    if not in_main_thread():
        return
    can_hold_back = hasattr(signal, "pthread_sigmask")  # not on Windows
    if can_hold_back:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    import pycolmap  # noqa: F401

    signal.signal(signal.SIGTERM, handler)
    if can_hold_back:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handle a signal by KeyboardInterrupt; during an import, which might swallow it, send it again a little later."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            _thread.start_new_thread(_send_later, (number,))  # without locks that the main thread may hold
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _send_later(number: int) -> None:
    time.sleep(0.05)
    if hasattr(signal, "pthread_kill"):  # which wakes the main thread from system calls; not on Windows
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        _thread.interrupt_main(signal.Signals(number))


def in_main_thread() -> bool:
    """Return whether the caller runs in the main thread."""
    return threading.current_thread() is threading.main_thread()


def _start_worker(stopped: Connection, started_by_main_thread: bool) -> None:
    """Initialize a worker process.

    On Linux the kernel kills it when the thread that started it ends, even inside a compiled function that holds the
    interpreter lock (prctl(2)); that is used only if this thread is the main thread, which lives as long as its
    process. Elsewhere a thread ends the worker.
    """
    if started_by_main_thread:
        with suppress(OSError, AttributeError, TypeError):  # TypeError: Windows has no library without a name
            ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG of sys/prctl.h
    threading.Thread(target=_exit_when_stopped, args=(stopped,), daemon=True).start()
    on_sigterm(signal.SIG_DFL)
    import cv2

    cv2.setNumThreads(1)
    collect_less_garbage()


def collect_less_garbage() -> None:
    """Look for cycles of unused objects less often: imports create many objects, which all live on."""
    gc.set_threshold(50_000, *gc.get_threshold()[1:])


def _exit_when_stopped(stopped: Connection) -> None:
    with suppress(EOFError, OSError):
        stopped.recv()  # returns at the end of the pipe: the parent has closed it or has ended
    os._exit(1)


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
    while True:
        try:
            file = _try_lock(lock, shared)
            break
        except BlockingIOError as error:
            if time.monotonic() >= deadline:
                holder = ""
                with suppress(OSError):
                    holder = lock.read_text(errors="replace")[:200]
                fix = "Wait until it has ended, or end it, and run again."
                raise InUseError("another process is using this", path=lock, value=holder, fix=fix) from error
        time.sleep(0.05)
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


def _try_lock(lock: Path, shared: bool) -> int | None:
    """Open and lock the file. Returns its descriptor, None if locking is impossible. Raises BlockingIOError if others hold it."""
    # not through a link, and without waiting for the other end of a pipe
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        if not shared:
            lock.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(lock, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.ENOSPC):
            return None
        raise
    try:
        lock_file(file, shared)
    except OSError as error:
        os.close(file)
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL):
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
