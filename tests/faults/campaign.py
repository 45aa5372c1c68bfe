"""The fault campaign: `PYTHONPATH=tests python -m faults.campaign --kills 200 --damages 200 --disks 20`.

Runs are forked from this process, which has imported everything, so that a kill costs seconds. Needs Linux; full disks
and several jobs need root. Ends with exit code 1 if any fault did harm, and prints what was tried and what went wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from faults import cases, damage, kills
from faults.kills import Outcome
from faults.runs import import_everything


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m faults.campaign", description=__doc__)
    add = parser.add_argument
    add("--kills", type=int, default=200, help="how many kills")
    add("--damages", type=int, default=0, help="how many damaged files")
    add("--disks", type=int, default=0, help="how many full disks")
    add("--only", nargs="*", default=[], help="names of cases to disturb, instead of all")
    add("--readers", nargs="*", default=[], help="names of readers to damage files of, instead of all")
    add("--seed", type=int, default=0)
    add("--jobs", type=int, default=1, help="how many at the same time; more than 1 needs root")
    add("--report", type=Path, help="where to write what came of it, as JSON lines")
    options = parser.parse_args(arguments)
    everything = [*cases.LINE, *cases.OTHERS, *cases.CHANGED]
    chosen = [case for case in everything if not options.only or case.name in options.only]
    start = time.monotonic()
    import_everything()
    _say(f"imported everything in {time.monotonic() - start:.0f} s")
    root = Path(tempfile.mkdtemp(prefix="faults-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    try:
        workshop = cases.Workshop(root, _say)
        rng = random.Random(options.seed)
        readers = [name for name in damage.READERS if not options.readers or name in options.readers]
        read = {damage.READERS[name][0] for name in readers if options.damages}
        read_cases = [case for case in everything if not case.again and (case.after or case.name) in read]
        workshop.make([*dict.fromkeys([*read_cases, *chosen])])
        chosen = [case for case in chosen if case.name in workshop.events]
        disturb = [("kill", pair) for pair in kills.planned(chosen, options.kills, rng)]
        disturb += [("damage", one) for one in damage.planned(workshop, readers, options.damages, rng)]
        fresh = [case for case in chosen if not case.again and "train" not in case.name]
        disturb += [("disk", (fresh[number % len(fresh)],)) for number in range(options.disks)]
        rng.shuffle(disturb)
        jobs = []
        for job in range(options.jobs):
            pid = os.fork()
            if pid == 0:
                _work(
                    workshop, disturb[job :: options.jobs], random.Random(f"{options.seed} {job}"), root, job, options
                )
            jobs.append(pid)
        codes = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in jobs]
        lines = [line for path in sorted(root.glob("outcomes-*")) for line in path.read_text().splitlines()]
    finally:
        shutil.rmtree(root, ignore_errors=True)
    outcomes = [Outcome(**json.loads(line)) for line in lines]
    if options.report:
        options.report.write_text("".join(f"{line}\n" for line in lines))
    _say(summary(outcomes, time.monotonic() - start))
    harm = [*workshop.broken, *(one for one in outcomes if one.problems)]
    return 0 if len(outcomes) == len(disturb) and not any(codes) and not harm else 1


def _work(workshop, tasks, rng, root, job, options) -> None:  # type: ignore[no-untyped-def]
    """A job: disturb one after the other, in files of its own. Does not return."""
    try:
        if options.jobs > 1 or options.disks:
            workshop.own_folder()
        do = {"kill": kills.killed, "damage": damage.damaged, "disk": damage.full_disk}
        with (root / f"outcomes-{job}").open("w") as file:
            for number, (kind, task) in enumerate(tasks, 1):
                outcome = do[kind](workshop, *task, rng)
                file.write(json.dumps(asdict(outcome)) + "\n")
                file.flush()
                wrong = "".join(f"\n    {problem}" for problem in outcome.problems)
                said = f"[{job}] {number}/{len(tasks)} {outcome.what}: {outcome.kind}, {outcome.at}"
                _say(f"{said}: {outcome.ended}{wrong}")
        os._exit(0)
    except BaseException:
        traceback.print_exc()
        os._exit(1)


def summary(outcomes: list[Outcome], seconds: float) -> str:
    """A Markdown table: how many faults of each kind, how the disturbed runs ended, how many did harm."""
    lines = ["", "| fault | tried | ended | did harm |", "| --- | --- | --- | --- |"]
    for kind in dict.fromkeys(sorted(one.kind for one in outcomes)):
        some = [one for one in outcomes if one.kind == kind]
        ended = ", ".join(f"{count} {how}" for how, count in sorted(Counter(one.ended for one in some).items()))
        lines.append(f"| {kind} | {len(some)} | {ended} | {sum(bool(one.problems) for one in some)} |")
    lines += ["", "| stage | tried | did harm |", "| --- | --- | --- |"]
    for what in dict.fromkeys(one.what for one in outcomes):
        some = [one for one in outcomes if one.what == what]
        lines.append(f"| {what} | {len(some)} | {sum(bool(one.problems) for one in some)} |")
    harm = sum(bool(one.problems) for one in outcomes)
    lines += ["", f"{len(outcomes)} faults in {seconds / 60:.0f} minutes, {harm} did harm"]
    for one in outcomes:
        lines += [f"  {one.what}: {one.kind}, {one.at}: {problem}" for problem in one.problems]
    return "\n".join(lines)


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
