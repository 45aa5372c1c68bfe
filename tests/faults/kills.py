"""Kills: a run ends at any moment, by SIGKILL, Ctrl-C or the loss of a worker; the same command then finishes it."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from faults.cases import Case, Workshop
from faults.runs import Hook, Run, at_file_events, contents

KINDS = ("SIGKILL at a change of a file", "SIGKILL at a moment", "Ctrl-C at a change of a file", "Ctrl-C at a moment",
         "SIGKILL of a worker")  # fmt: skip
SECONDS = 300.0  # after which a run is said to hang


@dataclass
class Outcome:
    """What came of one fault: `problems` is empty if all went as promised."""

    what: str  # the case
    kind: str
    at: str  # when, where
    problems: list[str] = field(default_factory=list)
    ended: str = ""  # how the disturbed run ended
    seconds: float = 0.0


def planned(cases: Sequence[Case], n: int, rng: random.Random) -> list[tuple[Case, str]]:
    """Cases and kinds of kills, all equally often, but those with workers, which take longer, half as often.

    But a worker is killed three times as often as that.
    """
    pairs: list[tuple[Case, str]] = []
    for case in cases:
        kinds = (*KINDS, *KINDS[4:] * 2) if case.workers else KINDS[:4] * 2
        pairs += [(case, kind) for kind in kinds]
    chosen: list[tuple[Case, str]] = []
    while len(chosen) < n:
        rng.shuffle(pairs)
        chosen += pairs
    return chosen[:n]


def killed(workshop: Workshop, case: Case, kind: str, rng: random.Random) -> Outcome:
    """Disturb a run, then run it again, and compare. A run that had finished by then is disturbed anew, earlier."""
    for _ in range(4):
        outcome = _killed(workshop, case, kind, rng)
        if outcome.ended != "had finished" or outcome.problems:
            break
    return outcome


def _killed(workshop: Workshop, case: Case, kind: str, rng: random.Random) -> Outcome:
    start = time.monotonic()
    workshop.restore(case.before)
    interrupted = kind.startswith("Ctrl-C")
    number = signal.SIGINT if interrupted else signal.SIGKILL
    if "change of a file" in kind:
        event = rng.randint(1, max(1, workshop.events[case.name]))
        at = f"change {event} of {workshop.events[case.name]}"
        hook = _signals_itself(workshop, event, number)
        run = Run(workshop.folder, case.arguments).start(hook)
    else:
        moment = rng.uniform(0, workshop.seconds[case.name])
        at = f"{moment:.2f} s of {workshop.seconds[case.name]:.2f}"
        run = Run(workshop.folder, case.arguments).start()
        _after(run, moment)
        if "worker" in kind:
            _kill_a_worker(run, rng)
        elif run.code is None:
            with suppress(ProcessLookupError):
                (os.killpg if interrupted else os.kill)(run.pid, number)
    outcome = Outcome(case.name, kind, at)
    problems = outcome.problems
    try:
        code = run.wait(SECONDS)
    except TimeoutError as error:
        outcome.problems.append(f"it hangs: {error}")
        return outcome
    if code == 0 and "worker" not in kind:
        workshop.seconds[case.name] = min(workshop.seconds[case.name], time.monotonic() - run.started)
    outcome.ended = {0: "went on" if "worker" in kind else "had finished", -9: "killed", 130: "interrupted"}.get(
        code, f"exit code {code}"
    )
    allowed = {"SIGKILL of a worker": (0, 2), "Ctrl-C": (0, 130), "SIGKILL": (0, -9)}
    if code == 2 and "no path was found" in run.err:  # in its seconds, on a machine that does much else
        outcome.ended = "no path in time"
    elif code not in next(codes for name, codes in allowed.items() if kind.startswith(name)):
        problems.append(f"ended with {code}: {run.err[-600:]}")
    if "Traceback" in run.err and not (case.name == "train, two processes" and "wheretolook: interrupted" in run.err):
        problems.append(f"a traceback: {run.err[-1500:]}")
    if interrupted or code == 2:
        left = [path for path in contents(workshop.folder) if ".partial" in path or "/." in path]
        left += [f"temporary {path.name}" for path in run.temporary.iterdir()]
        if left:
            problems.append(f"left behind when interrupted: {left}")
    again = Run(workshop.folder, [*case.rerun, *_ONE_WORKER.get(case.rerun[0], ())]).start(_labels_here)
    try:
        code = again.wait(SECONDS)
    except TimeoutError as error:
        outcome.problems.append(f"the next run hangs: {error}")
        return outcome
    if code != 0:
        problems.append(f"the next run ended with {code}: {again.err[-1500:]}")
    else:
        problems += workshop.differences(case)
        problems += [f"temporary {path.name}" for path in again.temporary.iterdir()]
    problems += [f"still running: {command}" for command in [*run.outlived_by(), *again.outlived_by()]]
    outcome.seconds = time.monotonic() - start
    return outcome


_ONE_WORKER = dict.fromkeys(("map", "label", "demo", "compare-paths"), ("--label.workers", "1"))


def _labels_here() -> None:
    """The next run labels in its own process: quicker, and the same labels are promised for any number of workers."""
    from wheretolook.localization import local_engine
    from wheretolook.localization.shard import ShardWorker

    def run_local(shards, workers, tick):  # type: ignore[no-untyped-def]
        worker = ShardWorker()
        for shard in shards:
            yield shard, worker.label(shard.job, shard.rows, tick)

    local_engine.run_local = run_local


def _signals_itself(workshop: Workshop, event: int, number: int) -> Hook:
    def do(count: int) -> None:
        if count == event:
            (os.killpg if number == signal.SIGINT else os.kill)(os.getpid(), number)

    return at_file_events(workshop.folder, do)


def _after(run: Run, moment: float) -> None:
    """Wait until a moment of a run, or its end."""
    _until(lambda: time.monotonic() - run.started >= moment, run)


def _kill_a_worker(run: Run, rng: random.Random) -> None:
    found: list[int] = []

    def there() -> bool:
        found[:] = run.workers()
        return bool(found)

    _until(there, run)
    if found:
        with suppress(ProcessLookupError):
            os.kill(rng.choice(found), signal.SIGKILL)


def _until(condition: Callable[[], bool], run: Run) -> None:
    while run.code is None and not condition():
        pid, status = os.waitpid(run.pid, os.WNOHANG)
        if pid:
            run.code = os.waitstatus_to_exitcode(status)
            return
        time.sleep(0.005)
