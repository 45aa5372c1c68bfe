"""One execution of a target: some bytes in place of one of its files, read as the package reads it, and judged.

Good are a result and an error of `wheretolook.utils.errors`. Anything else is a finding: another error, more than
1 GB, a file written elsewhere, a process started, an object of a pickle. What ends the process (a crash of native code,
more than 10 s) is seen by the process that started it, see `fuzz.py`.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheretolook.utils.errors import WhereToLookError

SECONDS = 10  # of the processor's time, and this reads files of a few kilobytes
MEMORY_BYTES = 1_000_000_000
ADDRESSES_BYTES = 8_000_000_000  # beyond what is mapped at the start: memory may be asked for that is never touched
_STARTS = {
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.fork",
    "socket.connect",
    "pickle.find_class",
}
_WRITES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "os.chmod"}
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass(frozen=True)
class Target:
    """What is read.

    Args:
        name: of the target.
        make: writes whole files into a folder; from them everything begins.
        files: those of the files that are replaced, relative to the folder; the first byte of an input chooses one.
        read: reads the file that was replaced, and what lies beside it.
        in_memory: whether `read` takes a path's content, as text, and no file is written for it, which takes longest.
    """

    name: str
    make: Callable[[Path], object]
    files: tuple[str, ...]
    read: Callable[[Any], object]
    in_memory: bool = False


@dataclass(frozen=True)
class Finding:
    """What should not have happened."""

    kind: str  # in one line: the error, and the lines of code where it arose
    text: str  # all that is known of it


class Execution:
    """Runs a target in a folder of its own, in this process, whose limits it sets if it is told to."""

    def __init__(self, target: Target, folder: Path, limits: bool = False) -> None:
        self.target = target
        self.folder = folder.resolve()
        self.files = [self.folder / name for name in target.files]
        (self.folder / "tmp").mkdir(parents=True, exist_ok=True)
        tempfile.tempdir = str(self.folder / "tmp")
        target.make(self.folder)
        self.whole = [path.read_bytes() for path in self.files]
        self._open = [os.open(path, os.O_RDWR) for path in self.files]
        self.written: list[str] = []
        self._changed = 0  # the file that is not whole
        warnings.simplefilter("ignore")
        self.limits = limits
        self._watches = False
        self._resolve_all()
        if limits:
            _limit_addresses()
            sys.addaudithook(self._audit)

    @property
    def seeds(self) -> list[bytes]:
        """The whole files, as inputs."""
        if len(self.files) == 1:
            return self.whole
        return [bytes([number]) + content for number, content in enumerate(self.whole)]

    def run(self, data: bytes) -> bool | Finding:
        """Whether the bytes were read (True), refused (False), or what went wrong."""
        number = 0
        if len(self.files) > 1:
            if not data:
                return False
            number = data[0] % len(self.files)
            data = data[1:]
        if not self.target.in_memory:
            if number != self._changed:
                self._write(self._changed, self.whole[self._changed])
                self._changed = number
            self._write(number, data)
        if self.limits:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
        self._watches = self.limits
        found = self._read(data.decode(errors="replace") if self.target.in_memory else self.files[number])
        self._watches = False
        if self.limits:
            signal.setitimer(signal.ITIMER_PROF, 0)
        if self.limits and 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) > MEMORY_BYTES:
            return Finding("more than 1 GB of memory", "")
        if self.written:
            what = self.written[0]
            self.written = []
            return Finding(f"not confined: {what}", "")
        return found

    def _write(self, number: int, data: bytes) -> None:
        """Replace what a file holds, also where a reader has replaced the file."""
        path = self.files[number]
        file = self._open[number]
        found = os.stat(path) if path.is_file() and not path.is_symlink() else None
        if found is None or found.st_ino != os.fstat(file).st_ino:
            os.close(file)
            file = self._open[number] = os.open(path, os.O_RDWR | os.O_CREAT)
        os.pwrite(file, data, 0)
        os.ftruncate(file, len(data))

    def _read(self, what: Path | str) -> bool | Finding:
        try:
            self.target.read(what)
        except WhereToLookError:
            return False
        except BaseException as error:  # SystemExit is one of argparse, RecursionError one of a parser
            return Finding(_kind(error), "".join(traceback.format_exception(error))[-6000:])
        return True

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Notes what is started or written elsewhere; an error raised here could be caught."""
        if not self._watches:
            return
        if event == "open":
            if isinstance(arguments[2], int) and arguments[2] & _WRITING:
                self._note_write(event, arguments[0])
        elif event in _WRITES:
            within = arguments[-1] if isinstance(arguments[-1], int) and event not in ("os.truncate",) else -1
            self._note_write(event, arguments[0], within)
        elif event in _STARTS:
            self.written.append(f"{event} {arguments!r:.200}")

    def _note_write(self, event: str, path: Any, within: int = -1) -> None:
        """`within` is a descriptor of the folder that the path is relative to, -1 for the working folder."""
        if isinstance(path, int) or os.fspath(path) in ("/dev/null", b"/dev/null"):
            return
        base = os.readlink(f"/proc/self/fd/{within}") if within >= 0 else ""
        text = os.path.realpath(os.path.join(base, os.fsdecode(path)))
        if not f"{text}/".startswith(f"{self.folder}/"):
            self.written.append(f"{event} {os.path.relpath(text, self.folder)}")

    def _resolve_all(self) -> None:
        """Read each file as it is, so that all is imported and made that is made once."""
        for number, seed in enumerate(self.seeds):
            found = self.run(seed)
            if found is not True:
                text = found.text if isinstance(found, Finding) else "refused"
                raise AssertionError(f"{self.target.name}: {self.target.files[number]} as it is cannot be read: {text}")


def _kind(error: BaseException) -> str:
    """An error's type, and the lines where it arose: the last of this project, and the last of all."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/wheretolook/" in frame.filename]
    where = [f"{'/'.join(frame.filename.split('/')[-2:])}:{frame.name}" for frame in own[-1:] + frames[-1:]]
    return " ".join([type(error).__name__, *where])


def _limit_addresses() -> None:
    with open("/proc/self/statm") as file:
        mapped = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + ADDRESSES_BYTES, mapped + ADDRESSES_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
