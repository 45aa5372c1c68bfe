"""Fuzzes the package's readers: `python tests/faults/fuzz/fuzz.py --minutes 60 --jobs 2 --out FOLDER`.

Needs Linux. With atheris (`pip install -e '.[test,fuzz]'`) inputs follow the code that they reach, without it bytes
are changed at random. Each target has processes of its own, one after the other, that read in a folder in memory, with
limits on time and memory. FOLDER keeps what was found: of each finding the smallest input and its error, `report.json`,
and the corpus, from which the next run with the same FOLDER goes on. Exits with 1 if there is any finding. An input is
looked at again by `fuzz.py TARGET --replay FILE`; once mended, it goes to found/TARGET/, where a test replays it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import mmap
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

_TESTS = Path(__file__).resolve().parents[2]
# When the process was ready; executions, of these read, of these refused; length of the input that runs.
_HEAD = struct.Struct("<dQQQI")
_MOST_BYTES = 1 << 20
_MOST_STARTS = 200  # of processes of a target
_MOST_KINDS = 100  # of findings of a target
_IDLE_S = 300  # without a single execution, on a busy machine
_SHARE = {"settings": 0.3, "arguments": 0.3}  # of the time that a target has; 1 if it is not named


def main() -> int:
    options = _options()
    sys.path[:0] = [str(_TESTS.parent / "src"), str(_TESTS)]
    if options.worker:
        return _work(options)
    options.out.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: _stop())
    names = options.targets
    if not names:
        from faults.fuzz.targets import TARGETS

        names = list(TARGETS)
    share = {name: _SHARE.get(name, 1.0) * (options.fast if name in _FAST else 1.0) for name in names}
    seconds = 60 * options.minutes * options.jobs / sum(share.values())
    print(
        f"{len(names)} targets, about {seconds:.0f} s each, on {options.jobs} processes, engine {options.engine}",
        flush=True,
    )
    with ThreadPoolExecutor(options.jobs) as pool:
        work = [pool.submit(_fuzz, name, seconds * share[name], options) for name in names]
        results = [future.result() for future in work]
    (options.out / "report.json").write_text(json.dumps(results, indent=2) + "\n")
    print(_table(results))
    return 1 if any(result["findings"] for result in results) else 0


_FAST = ("camera-texts", "short-texts", "glb-checks")
"""Targets without files, of ten thousand executions a second; they can have more of the time."""


def _options() -> argparse.Namespace:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = made.add_argument
    add("targets", nargs="*", metavar="TARGET", help="all of them, unless some are named")
    add("--minutes", type=float, default=60.0, help="of all targets together (60)")
    add("--jobs", type=int, default=2, help="processes at a time (2)")
    add("--fast", type=float, default=3.0, help="how much more time targets have that are quick (3)")
    add("--out", type=Path, default=Path("fuzzed"), metavar="FOLDER", help="findings, report and corpus (fuzzed)")
    add("--engine", choices=("atheris", "bytes"), default=_engine(), help="atheris if it is installed")
    add("--replay", type=Path, metavar="FILE", help="read this input of one TARGET, with all limits, and nothing else")
    add("--worker", help=argparse.SUPPRESS)
    add("--seconds", type=float, help=argparse.SUPPRESS)
    add("--seed", type=int, default=0, help="of what is random (0)")
    return made.parse_args()


def _engine() -> str:
    from importlib.util import find_spec

    return "atheris" if find_spec("atheris") else "bytes"


def _fuzz(name: str, seconds: float, options: argparse.Namespace) -> dict[str, Any]:
    """Run a target's processes one after the other, until its time is over. Returns the row of the report."""
    folder = options.out / name
    (folder / "findings").mkdir(parents=True, exist_ok=True)
    state = _State(folder / "state", new=True)
    starts = 0
    seed = options.seed
    took = 0.0
    while (left := seconds - took) > 0 and starts < _MOST_STARTS:
        command = [sys.executable, str(Path(__file__).resolve()), "--worker", name, "--out", str(options.out)]
        command += ["--seconds", f"{left:.1f}", "--seed", str(seed + starts), "--engine", options.engine]
        if options.replay:
            command += ["--replay", str(options.replay)]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "GLOG_minloglevel": "3", "PYTHONWARNINGS": "ignore"}
        starts += 1
        state.start(0.0)
        with (folder / "log.txt").open("ab") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, start_new_session=True)
            _RUNNING.add(process.pid)
            ended = _wait(process, state)
            _RUNNING.discard(process.pid)
        if not state.ready():
            raise SystemExit(f"{name} does not start, see {folder / 'log.txt'}")
        took += time.monotonic() - state.ready()
        if ended != "":
            _keep(folder, ended, "", state.input())
        if ended == "" or options.replay:
            break
    executions, read, refused = state.counts()
    findings = sorted(path.stem for path in (folder / "findings").glob("*.bin"))
    kinds = [(folder / "findings" / f"{stem}.txt").read_text().partition("\n")[0] for stem in findings]
    result = {"target": name, "executions": executions, "seconds": round(took, 1), "read": read, "refused": refused}
    result |= {"per_second": round(executions / took, 1), "processes": starts, "findings": kinds}
    about = f"{name:<16}{executions:>12,} executions {result['per_second']:>10,.0f} a second {len(kinds)} findings"
    with _PRINTING:
        print("\n    ".join([about, *kinds]), flush=True)
    return result


_PRINTING = Lock()


_RUNNING: set[int] = set()


def _stop() -> None:
    """End with all processes of targets."""
    for number in _RUNNING:
        os.kill(number, signal.SIGKILL)
    os._exit(143)


def _wait(process: subprocess.Popen[bytes], state: _State) -> str:
    """How a process has ended that should not have ended so; "" if its time was over."""
    last = state.counts()[0]
    since = time.monotonic()
    while True:
        try:
            code = process.wait(1)
        except subprocess.TimeoutExpired:
            now = state.counts()[0]
            if now != last:
                last = now
                since = time.monotonic()
            elif state.ready() and time.monotonic() - max(since, state.ready()) > _IDLE_S:
                process.kill()
                process.wait()
                return f"hangs for {_IDLE_S} s"
            continue
        if code == 0:
            return ""
        if code == -signal.SIGPROF:
            return "more than 10 s"
        return f"ends the process: {signal.Signals(-code).name if code < 0 else f'exit code {code}'}"


class _State:
    """Counts of executions, and the input that runs, in a file that outlives the process."""

    def __init__(self, path: Path, new: bool = False) -> None:
        if new:
            path.write_bytes(bytes(_HEAD.size + _MOST_BYTES))
        self.since = 0.0
        with path.open("r+b") as file:
            self.map = mmap.mmap(file.fileno(), _HEAD.size + _MOST_BYTES)

    def counts(self) -> tuple[int, int, int]:
        return _HEAD.unpack_from(self.map)[1:4]

    def ready(self) -> float:
        """When the last process began to read, by a clock that all have; 0 if it has not."""
        return float(_HEAD.unpack_from(self.map)[0])

    def input(self) -> bytes:
        return self.map[_HEAD.size : _HEAD.size + _HEAD.unpack_from(self.map)[4]]

    def begin(self, counts: list[int], data: bytes) -> None:
        self.map[_HEAD.size : _HEAD.size + len(data)] = data
        _HEAD.pack_into(self.map, 0, self.since, *counts, len(data))

    def start(self, at: float) -> None:
        """Note when a process is ready; 0 when it is not yet."""
        self.since = at
        struct.pack_into("<d", self.map, 0, at)


def _work(options: argparse.Namespace) -> int:
    """Be one process of a target."""
    name = options.worker
    folder = options.out / options.worker
    memory = Path("/dev/shm")
    scratch = Path(tempfile.mkdtemp(prefix="fuzz-", dir=memory if memory.is_dir() else None))
    try:
        return _loop(name, folder.resolve(), scratch, options)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _loop(name: str, folder: Path, scratch: Path, options: argparse.Namespace) -> int:
    if options.engine == "atheris":
        import atheris

        with atheris.instrument_imports(include=["wheretolook", "trimesh.exchange"]):
            target = _target(name)
    else:
        target = _target(name)
    from faults.fuzz.execution import Execution, Finding

    execution = Execution(target, scratch / name, limits=True)
    state = _State(folder / "state")
    counts = list(state.counts())
    state.start(time.monotonic())

    def one(data: bytes) -> None:
        if len(data) > _MOST_BYTES:
            return
        counts[0] += 1
        state.begin(counts, data)
        found = execution.run(data)
        if isinstance(found, Finding):
            _keep(folder, found.kind, found.text, data)
        else:
            counts[1 if found else 2] += 1

    if options.replay:
        one(options.replay.read_bytes())
        state.begin(counts, b"")
        return 0
    longest = max(4096, 2 * max(map(len, execution.seeds)))
    end = time.monotonic() + options.seconds
    if options.engine == "bytes":
        from faults.fuzz.mutate import mutated

        rng = random.Random(options.seed)
        seeds = execution.seeds
        while time.monotonic() < end:
            one(mutated(rng.choice(seeds), rng)[:longest])
        state.begin(counts, b"")
        return 0
    corpus = folder / "corpus"
    words = folder / "words.txt"
    corpus.mkdir(exist_ok=True)
    for seed in execution.seeds:
        (corpus / hashlib.sha1(seed).hexdigest()).write_bytes(seed)
    from faults.fuzz.mutate import WORDS

    escaped = ("".join(f"\\x{byte:02x}" for byte in word[:60]) for word in WORDS)
    words.write_text("".join(f'"{word}"\n' for word in escaped))
    flags = {"max_total_time": max(1, int(options.seconds)), "max_len": longest, "seed": options.seed + 1}
    flags |= {"rss_limit_mb": 0, "timeout": 86_400, "verbosity": 0, "reload": 0, "len_control": 0, "detect_leaks": 0}
    flags |= dict.fromkeys([f"handle_{name}" for name in ("segv", "bus", "abrt", "ill", "fpe")], 0)
    arguments = [sys.argv[0], *(f"-{name}={value}" for name, value in flags.items()), f"-dict={words}", str(corpus)]
    atheris.Setup(arguments, one)
    try:
        atheris.Fuzz()
    finally:
        state.begin(counts, b"")
    return 0


def _target(name: str) -> Any:
    if name == "faulty":
        from faults.fuzz.faulty import FAULTY

        return FAULTY
    from faults.fuzz.targets import TARGETS

    return TARGETS[name]


def _keep(folder: Path, kind: str, text: str, data: bytes) -> None:
    """Keep the smallest input of a kind of finding."""
    if sum(1 for _ in (folder / "findings").glob("*.bin")) >= _MOST_KINDS:
        return
    path = folder / "findings" / f"{hashlib.sha1(kind.encode()).hexdigest()[:10]}.bin"
    if not path.is_file() or len(data) < path.stat().st_size:
        path.write_bytes(data)
        path.with_suffix(".txt").write_text(f"{kind}\n{text}")


def _table(results: list[dict[str, Any]]) -> str:
    rows = ["| target | executions | a second | read | refused | findings |", "|---|---|---|---|---|---|"]
    for row in results:
        cells = f"{row['executions']:,} | {row['per_second']:,.0f} | {row['read']:,} | {row['refused']:,}"
        rows.append(f"| {row['target']} | {cells} | {len(row['findings'])} |")
    total = sum(row["executions"] for row in results)
    return "\n".join([*rows, f"{total:,} executions, {sum(len(row['findings']) for row in results)} findings"])


if __name__ == "__main__":
    sys.exit(main())
