"""Runs of the command line that start in no time: forked from a process that has imported everything already.

A run is killed, interrupted or given a full disk; what it leaves is compared file by file.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import importlib
import multiprocessing
import os
import pkgutil
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from matplotlib.figure import Figure

Hook = Callable[[], None]
"""Called in the new process before it works."""

HEAVY = ("mlflow.store.tracking.sqlalchemy_store", "lightning.pytorch", "sqlalchemy", "pycolmap", "cv2", "lightgbm",
         "trimesh", "matplotlib.backends.backend_agg", "pyarrow.parquet", "poselib", "warp", "scipy.spatial",
         "sklearn.metrics", "onnx")  # fmt: skip


def import_everything() -> None:
    """So that a forked process has it all. Nothing is computed, for threads do not survive a fork."""
    import wheretolook

    os.environ["GLOG_logtostderr"] = "1"  # noqa: SIM112 - as `cli.main` does before COLMAP is loaded
    for module in pkgutil.walk_packages(wheretolook.__path__, "wheretolook."):
        with contextlib.suppress(ImportError):  # what optional packages would be needed for
            importlib.import_module(module.name)
    for name in HEAVY:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


@dataclass
class Run:
    """One run of the command line in a folder, in a session of its own; what it said is in two files beside it."""

    folder: Path
    arguments: list[str]
    pid: int = 0
    started: float = 0.0
    code: int | None = None  # negative: the signal that ended it

    @property
    def out(self) -> str:
        return self._beside("out").read_text(errors="replace")

    @property
    def err(self) -> str:
        return self._beside("err").read_text(errors="replace")

    @property
    def temporary(self) -> Path:
        """Its folder of temporary files."""
        return self._beside("tmp")

    def _beside(self, kind: str) -> Path:
        return self.folder.with_name(f"{self.folder.name}.{kind}")

    def start(self, hook: Hook | None = None) -> Run:
        self.temporary.mkdir(exist_ok=True)
        for path in self.temporary.iterdir():
            _remove(path)
        self.started = time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            self._work(hook)
        return self

    def _work(self, hook: Hook | None) -> None:
        code = 1
        try:
            os.setsid()
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            os.chdir(self.folder)
            for number, kind in ((1, "out"), (2, "err")):
                file = os.open(self._beside(kind), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                os.dup2(file, number)
            os.environ["TMPDIR"] = tempfile.tempdir = str(self.temporary)
            sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
            sys.argv = ["wheretolook", *self.arguments]
            main = sys.modules["__main__"]  # workers that are spawned need nothing of it
            main.__spec__ = None
            if hasattr(main, "__file__"):
                del main.__file__
            multiprocessing.util._finalizer_registry.clear()  # type: ignore[attr-defined]
            atexit._clear()
            atexit.register(multiprocessing.util._exit_function)  # type: ignore[attr-defined]
            if hook is not None:
                hook()
            Figure.savefig = _no_picture  # type: ignore[method-assign]
            main_of = importlib.import_module("wheretolook.cli").main
            signal.signal(signal.SIGINT, signal.default_int_handler)
            code = main_of(self.arguments)
            threading._shutdown()  # type: ignore[attr-defined]
            atexit._run_exitfuncs()
        except BaseException:
            traceback.print_exc()
        finally:
            with contextlib.suppress(BaseException):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)

    def wait(self, seconds: float = 600) -> int:
        """Its exit code, negative for a signal; it is killed, and an error is raised, if it takes too long."""
        while self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
            elif time.monotonic() - self.started > seconds:
                for member in self.members():
                    os.kill(member, signal.SIGKILL)
                os.waitpid(self.pid, 0)
                raise TimeoutError(f"no end after {seconds:.0f} s: {' '.join(self.arguments)}\n{self.err[-2000:]}")
            else:
                time.sleep(0.01)
        return self.code

    def members(self) -> list[int]:
        """Processes of its session: itself, and what it has started."""
        found = []
        for entry in os.scandir("/proc"):
            if entry.name.isdecimal():
                with contextlib.suppress(OSError):
                    fields = Path(entry.path, "stat").read_text().rpartition(")")[2].split()
                    if int(fields[3]) == self.pid and fields[0] != "Z":
                        found.append(int(entry.name))
        return found

    def workers(self) -> list[int]:
        """Processes that it has started to work for it."""
        found = []
        for pid in self.members():
            with contextlib.suppress(OSError):
                if pid != self.pid and b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    found.append(pid)
        return found

    def outlived_by(self, seconds: float = 20) -> list[str]:
        """Commands of processes that it has started and that do not end within some time after it; they are killed."""
        deadline = time.monotonic() + seconds
        while (left := self.members()) and time.monotonic() < deadline:
            time.sleep(0.05)
        found = []
        for pid in left:
            with contextlib.suppress(OSError):
                found.append(Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace"))
                os.kill(pid, signal.SIGKILL)
        return found


def run(folder: Path, arguments: list[str], hook: Hook | None = None, seconds: float = 600) -> Run:
    """A run that has ended."""
    one = Run(folder, arguments).start(hook)
    one.wait(seconds)
    return one


def contents(folder: Path) -> dict[str, str]:
    """A digest of each file of a folder by its path there, and "" for each empty folder; without the MLflow store."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name.split("/")[0] == "mlruns":
            continue
        if path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.is_dir() and not any(path.iterdir()):
            found[f"{name}/"] = ""
    return found


_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "shutil.rmtree")


def at_file_events(folder: Path, do: Callable[[int], None]) -> Hook:
    """A hook that calls `do` with a number that counts up, before each change of a file or folder in a folder."""

    def hook() -> None:
        mine = os.getpid()
        count = 0
        root = f"{folder}/"

        def audit(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal count
            if event == "open":
                if not (isinstance(arguments[2], int) and arguments[2] & _WRITES):
                    return
            elif event not in _EVENTS:
                return
            if event in ("os.remove", "os.rmdir") and arguments[1] != -1:
                return  # a part of a folder that is being removed, elsewhere perhaps
            path = arguments[0]
            if not isinstance(path, (str, os.PathLike)) or os.getpid() != mine:
                return
            if os.path.abspath(path).startswith(root) and "/mlruns/" not in str(path):
                count += 1
                do(count)

        sys.addaudithook(audit)

    return hook


def _no_picture(figure: Figure, file: IO[bytes] | str | Path, **options: object) -> None:
    """Figures are built, but their files stay all but empty: drawing is a third of a small evaluation."""
    if isinstance(file, str | Path):
        Path(file).write_bytes(b"picture")
    else:
        file.write(b"picture")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
