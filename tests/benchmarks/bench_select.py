"""Measure `wheretolook select` as a process, start-up and reading of the map included: wall and CPU time.

With --cold each run compiles its kernels, as the first on a machine.

python tests/benchmarks/bench_select.py --landmarks 25000 --waypoints 20 --repeats 5
python tests/benchmarks/bench_select.py --landmarks 100000 --waypoints 1000 --cold
"""

import itertools
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import options, seconds_of, show, write_model, write_waypoints


def cpu_seconds():
    """Return the CPU seconds of all processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main():
    args = options(__doc__, landmarks=25_000, waypoints=20, occlusion="none", device="cpu", cold=False, repeats=3)
    with tempfile.TemporaryDirectory() as folder:
        write_model(Path(folder) / "sparse", args.landmarks)
        write_waypoints(args.waypoints, Path(folder) / "at.csv")
        command = [sys.executable, "-m", "wheretolook", "select", "--map", "sparse", "--at", "at.csv"]
        command += ["--out", "views.csv", "--device", args.device, "--occlusion", args.occlusion]
        runs = itertools.count()

        def select():
            cache = {"WARP_CACHE_PATH": f"{folder}/kernels-{next(runs)}"} if args.cold else {}
            subprocess.run(command, cwd=folder, check=True, env=os.environ | cache)

        print(f"{args.waypoints:,} waypoints, 500 directions, {args.landmarks:,} landmarks")
        for name, clock in (("wall", time.perf_counter), ("CPU", cpu_seconds)):
            show(name, seconds_of(select, args.repeats, clock))


if __name__ == "__main__":
    main()
