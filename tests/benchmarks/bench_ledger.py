"""Measure in a minute what must not become slower, and print the ratio to the last entry of the ledger for the device.

    make bench                                                  # on the CPU
    make bench BENCH='--device cuda --record'                   # on a GPU; appends the times to ledger.csv

Run it before finishing a change to a kernel or to its caller. Sizes are the paper's (`bench_visibility.py`), on a CPU with
every twentieth location, and 25,000 landmarks for `select`, whose process is timed from start to end. Localizing is of one
image by several hypotheses on one core (matching on the device): a tenth of its keypoints show landmarks, half of which
have a twin elsewhere.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from bench_visibility import CAMERA, COUNTS, EVERYTHING, Setup, machine, seconds_of
from common import SIDE_M, room_map, use_one_thread, write_model

from wheretolook.features.extractor import Keypoints, quantize_descriptors
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along, rotation_looking_along, transform
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.counting import SurveyOptions, survey
from wheretolook.visibility.occlusion import DevicePoints, NoOcclusion

LEDGER = Path(__file__).with_name("ledger.csv")
KEYPOINTS = 2000
COLUMNS = ("when", "commit", "device", "what", "median_s", "min_s", "max_s")


def visibility(args: argparse.Namespace, device: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield names and work of occlusion and counts."""
    setup = Setup(args, device, args.landmarks, args.locations or (648 if setup_on_gpu(device) else 32))
    landmarks = DevicePoints(setup.points, device)
    shared = (CAMERA, rotation_looking_along(fibonacci_sphere(500)), setup.locations, landmarks)
    about = f"{len(setup.locations)} x 500 x {args.landmarks:,}"

    def rays() -> None:
        setup.occlusion.unoccluded_on_device(setup.locations, landmarks)
        wp.synchronize_device(device)

    yield f"{EVERYTHING}: {about}", partial(survey, *shared, setup.occlusion, SurveyOptions(keep=100))
    options = SurveyOptions(keep=1, keep_occlusion=False)
    yield f"{COUNTS}: {about}", partial(survey, *shared, NoOcclusion(), options)
    yield f"occlusion alone: {about}", rays


def setup_on_gpu(device: str) -> bool:
    """Return whether a device is a GPU."""
    return bool(wp.get_device(device).is_cuda)


def select(args: argparse.Namespace, device: str, folder: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield names and work of `wheretolook select` at one waypoint and at 20."""
    write_model(folder / "sparse", args.landmarks)
    points = np.random.default_rng(1).uniform((1, 1, 1), (SIDE_M - 1, SIDE_M - 1, 2), (20, 3))
    for number in (1, len(points)):
        file = f"{number}.csv"
        np.savetxt(folder / file, points[:number], delimiter=",", header="x,y,z", comments="")
        command = [sys.executable, "-m", "wheretolook", "select", "--map", "sparse", "--at", file, "--scale", "1"]
        command += ["--out", "views.csv", "--occlusion", "none", "--device", device]
        work = partial(subprocess.run, command, cwd=folder, check=True, capture_output=True)
        yield f"select, {number} waypoints x 500 x {args.landmarks:,}, process", work


def localization(args: argparse.Namespace, device: str) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield names and work of matching an image's keypoints with landmarks, and of estimating its pose from these."""
    rng = np.random.default_rng(0)
    room = room_map(args.landmarks, np.zeros((1, 3)), "cpu").landmarks
    described = rng.gamma(0.3, size=(args.landmarks + KEYPOINTS, 128))
    described[1 : args.landmarks : 2] = described[: args.landmarks - 1 : 2] * rng.uniform(0.6, 1.6, 128)  # twins
    described /= np.linalg.norm(described, axis=1, keepdims=True)
    landmarks = replace(room, descriptors=quantize_descriptors(described[: args.landmarks]))
    pose = poses_looking_along([(0.0, 0.0, 1.2)], [(1.0, 0.2, 0.0)])[0]
    in_camera = transform(pose, room.points)
    shown = np.flatnonzero((in_camera[:, 2] > 0.1) & CAMERA.in_image(CAMERA.project(in_camera)))[: KEYPOINTS // 10]
    pixels = rng.uniform(0, (CAMERA.width, CAMERA.height), (KEYPOINTS, 2))
    pixels[: len(shown)] = CAMERA.project(in_camera[shown]) + rng.normal(0, 0.5, (len(shown), 2))
    seen = described[args.landmarks :].astype(np.float32)
    seen[: len(shown)] = described[shown]
    keypoints = replace(Keypoints.none(), pixels=pixels.astype(np.float32), descriptors=seen)
    localizer = Localizer(landmarks, CAMERA, LocalizerConfig("hypotheses"), device=device)
    use_one_thread()
    matches = localizer.match([keypoints])[0]
    about = f"an image, {KEYPOINTS:,} x {args.landmarks:,}"
    yield f"match {about}", partial(localizer.match, [keypoints])
    yield f"pose of {about}", partial(localizer.estimate, keypoints, matches)


def commit() -> str:
    """Return the abbreviated commit, with a plus sign if files are changed; empty outside a repository."""
    command = ["git", "describe", "--always", "--exclude", "*", "--abbrev=7", "--dirty=+"]
    return subprocess.run(command, cwd=LEDGER.parent, capture_output=True, text=True).stdout.strip()


def last_entries(ledger: Path, device: str) -> dict[str, dict[str, str]]:
    """Return the last entry of a device in the ledger for each thing that is measured."""
    if not ledger.exists():
        return {}
    with ledger.open(newline="") as file:
        return {row["what"]: row for row in csv.DictReader(file) if row["device"] == device}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="Warp's device")
    parser.add_argument("--locations", type=int, help="default: 648 on a GPU, 32 on a CPU")
    parser.add_argument("--landmarks", type=int, default=24_919)
    parser.add_argument("--triangles", type=int, default=250_000, help="minimum number of triangles")
    parser.add_argument("--repeats", type=int, default=20, help="of occlusion and counts; a fifth for processes")
    parser.add_argument("--ledger", type=Path, default=LEDGER)
    parser.add_argument("--record", action="store_true", help="append the times to the ledger")
    args = parser.parse_args()
    args.scene = None
    device = start_warp(args.device)
    about = machine(device)
    name = about["name"] if setup_on_gpu(device) else f"{about['host']}, {about['cores']} cores"
    before = last_entries(args.ledger, name)
    rows: list[dict[str, Any]] = []

    def add(what: str, work: Callable[[], object], repeats: int) -> None:
        times = {key: value for key, value in seconds_of(work, repeats).items() if key in COLUMNS}
        rows.append({"when": date.today().isoformat(), "commit": commit(), "device": name, "what": what, **times})
        last = before.get(what)
        ratio = f"{times['median_s'] / float(last['median_s']):.2f} of {last['commit']}" if last else "first entry"
        print(f"{what:62} {1e3 * times['median_s']:10,.2f} ms [{1e3 * times['min_s']:,.2f}, "
              f"{1e3 * times['max_s']:,.2f}]  {ratio}", flush=True)  # fmt: skip

    print(f"{name}, {commit()}")
    for what, work in visibility(args, device):
        add(what, work, args.repeats)
    for what, work in localization(args, device):
        add(what, work, args.repeats)
    with tempfile.TemporaryDirectory() as folder:
        for what, work in select(args, args.device, Path(folder)):
            add(what, work, max(1, args.repeats // 5))
    if args.record:
        new = not args.ledger.exists()
        with args.ledger.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerows({**row, **{key: f"{row[key]:.6g}" for key in COLUMNS[-3:]}} for row in rows)


if __name__ == "__main__":
    main()
