"""Measure the memory of a command with all its processes, and whether it grows.

    python tests/benchmarks/bench_load.py --minutes 60 label --config configs/small.yaml
    python tests/benchmarks/bench_load.py --limit-gb 16 select --map sparse/0 --at waypoints.csv --out views.csv

Runs `wheretolook` with the given arguments, interrupts it like Ctrl-C after `--minutes`, and kills it above
`--limit-gb`. Every `--every` seconds it reads the resident memory and the proportional memory (shared pages count once)
of all processes. Prints a line per minute and finally the peaks; for runs of ten minutes or more also the slope of a
line fitted to the readings after the first tenth of the time.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time

import numpy as np
import psutil

COMMAND = [sys.executable, "-c", "import sys; from wheretolook.cli import main; sys.exit(main(sys.argv[1:]))"]


def memory_mb(root: psutil.Process) -> tuple[float, float, int]:
    """Return resident and proportional memory in MB of a process and its descendants, and their number."""
    resident = 0
    own = 0
    n = 0
    try:
        processes = [root, *root.children(recursive=True)]
    except psutil.NoSuchProcess:
        processes = []
    for process in processes:
        try:
            memory = process.memory_full_info()
        except psutil.Error:  # the process has just ended
            continue
        resident = resident + memory.rss
        own = own + memory.pss
        n = n + 1
    return resident / 1e6, own / 1e6, n


def summarize(rows: list[tuple[float, float, float]]) -> None:
    """Print peaks and growth of readings (seconds, resident MB, proportional MB)."""
    seconds, resident, own = np.array(rows).T
    settled = seconds >= seconds[-1] / 10
    for name, megabytes in (("resident", resident), ("proportional", own)):
        line = f"{name:12} peak {megabytes.max():.0f} MB"
        if seconds[-1] >= 600:
            slope = np.polyfit(seconds[settled] / 3600, megabytes[settled], 1)[0]
            quarters = ", ".join(f"{np.median(part):.0f}" for part in np.array_split(megabytes[settled], 4))
            line += f"; slope {slope:+.1f} MB an hour; medians of the quarters {quarters} MB"
        print(line)


def main() -> int:
    """Run the command and sample its memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--limit-gb", type=float, default=float("inf"))
    parser.add_argument("--every", type=float, default=2.0)
    parser.add_argument("command", nargs=argparse.REMAINDER, help="what follows `wheretolook`")
    args = parser.parse_args()
    start = time.monotonic()
    minute = 0
    interrupted_s = 0.0
    ended = ""
    rows: list[tuple[float, float, float]] = []
    signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore it
    process = subprocess.Popen([*COMMAND, *args.command], start_new_session=True)
    root = psutil.Process(process.pid)
    while process.poll() is None:
        resident, own, n = memory_mb(root)
        seconds = time.monotonic() - start
        if n:
            rows.append((seconds, resident, own))
        if seconds // 60 > minute:
            minute = int(seconds // 60)
            print(f"{minute:4} min: {resident:6.0f} MB resident, {own:6.0f} MB proportional, {n} processes", flush=True)
        if resident > 1e3 * args.limit_gb:
            ended = f", killed beyond {args.limit_gb} GB"
            for child in root.children(recursive=True):
                child.kill()
            process.kill()
            process.wait()
        elif seconds > max(60 * args.minutes, interrupted_s + 30):
            ended = ", interrupted after the given time"
            interrupted_s = seconds
            process.send_signal(signal.SIGINT)
        time.sleep(args.every)
    print(f"exit {process.returncode} after {time.monotonic() - start:.1f} s{ended}")
    if rows:
        summarize(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
