"""Measure `wheretolook select` as a process, start-up and reading of the map included: wall and CPU time.

python tests/benchmarks/bench_select.py --landmarks 25000 --waypoints 20 --repeats 5
python tests/benchmarks/bench_select.py --landmarks 100000 --waypoints 1000 --cold
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import SIDE_M, write_model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, default=25_000)
    parser.add_argument("--waypoints", type=int, default=20)
    parser.add_argument("--occlusion", default="none", choices=("none", "hidden-points"))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--cold", action="store_true", help="each run compiles its kernels, as the first on a machine")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    points = np.random.default_rng(1).uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (options.waypoints, 3))
    wall: list[float] = []
    cpu: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        write_model(Path(folder) / "sparse", options.landmarks)
        np.savetxt(Path(folder) / "at.csv", points, delimiter=",", header="x,y,z", comments="")
        command = [sys.executable, "-m", "wheretolook", "select", "--map", "sparse", "--at", "at.csv"]
        command += ["--out", "views.csv", "--device", options.device, "--occlusion", options.occlusion]
        for run in range(options.repeats):
            env = os.environ | ({"WARP_CACHE_PATH": f"{folder}/kernels-{run}"} if options.cold else {})
            start = time.perf_counter()
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run(command, cwd=folder, check=True, env=env)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            wall.append(time.perf_counter() - start)
            cpu.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    print(f"{options.waypoints:,} waypoints, 500 directions, {options.landmarks:,} landmarks, {options.repeats} runs")
    for name, seconds in (("wall", wall), ("CPU", cpu)):
        print(f"{name}: median {np.median(seconds):.3g} s ({min(seconds):.3g} to {max(seconds):.3g})")


if __name__ == "__main__":
    main()
