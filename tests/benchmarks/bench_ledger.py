"""Measure in a minute what must not become slower, and print the ratio to the last entry of the ledger for the device.

    make bench                                                  # on the CPU
    make bench BENCH='--device cuda --record'                   # on a GPU; appends the times to ledger.csv

Run it before finishing a change to a kernel or to its caller. Sizes are the paper's (`bench_visibility.py`), on a CPU with
every twentieth location, and 25,000 landmarks for `select`, whose process is timed from start to end. Localizing is of one
image by several hypotheses on one core (matching on the device): a tenth of its keypoints show landmarks, half of which
have a twin elsewhere. A viewpoint map without a mesh is of 2,013 landmarks by hidden-point removal, and `check` of a
corridor of 30 photographs.
"""

import itertools
import subprocess
import sys
import tempfile
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import warp as wp
from bench_visibility import CAMERA, COUNTS, EVERYTHING, Setup, machine
from common import ROOM_M, options, room_map, seconds_of, show, use_one_thread, write_csv, write_model, write_waypoints

from holdout.corridor import write_corridor
from wheretolook.features.extractor import Keypoints, quantize_descriptors
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along, rotation_looking_along, transform
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.scorers.weights import load_scorer
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.counting import SurveyOptions, survey
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import CachedOcclusion, DevicePoints, NoOcclusion

LEDGER = Path(__file__).with_name("ledger.csv")
KEYPOINTS = 2000
COLUMNS = ("when", "commit", "device", "what", "median_s", "min_s", "max_s")


def visibility(args, device):
    """Yield names and work of occlusion and counts."""
    setup = Setup(args, device, args.landmarks, args.locations or (648 if setup_on_gpu(device) else 32))
    landmarks = DevicePoints(setup.points, device)
    shared = (CAMERA, rotation_looking_along(fibonacci_sphere(500)), setup.locations, landmarks)
    about = f"{len(setup.locations)} x 500 x {args.landmarks:,}"

    def rays():
        setup.occlusion.unoccluded_on_device(setup.locations, landmarks)
        wp.synchronize_device(device)

    yield f"{EVERYTHING}: {about}", partial(survey, *shared, setup.occlusion, SurveyOptions(keep=100))
    options = SurveyOptions(keep=1, keep_occlusion=False)
    yield f"{COUNTS}: {about}", partial(survey, *shared, NoOcclusion(), options)
    yield f"occlusion alone: {about}", rays


def setup_on_gpu(device):
    """Return whether a device is a GPU."""
    return bool(wp.get_device(device).is_cuda)


def select(args, device, folder):
    """Yield names and work of `wheretolook select` at one waypoint and at 20."""
    write_model(folder / "sparse", args.landmarks)
    for number in (1, 20):
        file = f"{number}.csv"
        write_waypoints(number, folder / file)
        command = [sys.executable, "-m", "wheretolook", "select", "--map", "sparse", "--at", file, "--scale", "1"]
        command += ["--out", "views.csv", "--occlusion", "none", "--device", device]
        work = partial(subprocess.run, command, cwd=folder, check=True, capture_output=True)
        yield f"select, {number} waypoints x 500 x {args.landmarks:,}, process", work


def scores(args, device):
    """Yield names and work of scoring all directions, and of a viewpoint map without a mesh."""
    rng = np.random.default_rng(0)
    low, high = np.array(ROOM_M) * 0.8
    axes = fibonacci_sphere(500)
    count = args.locations or (648 if setup_on_gpu(device) else 32)
    locations = rng.uniform(low, high, (count, 3))
    scorer = load_scorer(room_map(args.landmarks, locations, device))
    scorer.score_directions(locations[:1], axes)  # on every core
    yield f"scores of directions: {count} x 500 x {args.landmarks:,}", partial(scorer.score_directions, locations, axes)
    few = min(2_013, args.landmarks)
    grid = VoxelGrid.over(np.array([low, high]), (6, 6, 7))
    voxels = np.arange(args.locations or 246)

    def viewpoint_map():  # occlusion is computed each time
        hidden = replace(room_map(few, locations[:1], device), occlusion=CachedOcclusion(HiddenPointRemoval()))
        build_viewpoint_map(load_scorer(hidden), grid, voxels, axes)

    yield f"viewpoint map without a mesh: {len(voxels)} x 500 x {few:,}", viewpoint_map


def check(folder):
    """Return the work of `wheretolook check` on one core."""
    sparse, database = write_corridor(folder)
    command = [sys.executable, "-m", "wheretolook", "check", "--map", sparse, "--database", database, "--scale", "1"]
    command += ["--occlusion", "none", "--workers", "1", "--device", "cpu"]
    numbers = itertools.count()

    def work():
        out = folder / f"out-{next(numbers)}"  # results are kept
        subprocess.run([*map(str, command), "--out", str(out)], cwd=folder, check=True, capture_output=True)

    return work


def localization(args, device):
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


def commit():
    """Return the abbreviated commit, with a plus sign if files are changed; empty outside a repository."""
    command = ["git", "describe", "--always", "--exclude", "*", "--abbrev=7", "--dirty=+"]
    return subprocess.run(command, cwd=LEDGER.parent, capture_output=True, text=True).stdout.strip()


def last_entries(ledger, device):
    """Return the last entry of a device in the ledger for each thing that is measured."""
    if not ledger.exists():
        return {}
    table = pd.read_csv(ledger, dtype={"commit": str})
    return {row["what"]: row for row in table[table["device"] == device].to_dict("records")}


def main():
    args = options(
        __doc__,
        device="cpu",
        locations=int,
        landmarks=24_919,
        triangles=250_000,
        repeats=20,
        ledger=LEDGER,
        record=False,
    )
    args.scene = None
    device = start_warp(args.device)
    about = machine(device)
    name = about["name"] if setup_on_gpu(device) else f"{about['host']}, {about['cores']} cores"
    before = last_entries(args.ledger, name)
    rows = []

    def add(what, work, repeats):
        times = seconds_of(work, repeats, limit_s=3.0)
        rows.append({"when": date.today().isoformat(), "commit": commit(), "device": name, "what": what, **times})
        last = before.get(what)
        show(what, times, f"{times['median_s'] / last['median_s']:.2f} of {last['commit']}" if last else "first entry")

    print(f"{name}, {commit()}")
    for what, work in itertools.chain(visibility(args, device), scores(args, device), localization(args, device)):
        add(what, work, args.repeats)
    with tempfile.TemporaryDirectory() as folder:
        for what, work in select(args, args.device, Path(folder)):
            add(what, work, max(1, args.repeats // 5))
        add("check, 30 photographs, process", check(Path(folder, "corridor")), max(1, args.repeats // 20))
    if args.record:
        earlier = [pd.read_csv(args.ledger, dtype={"commit": str})] if args.ledger.exists() else []
        write_csv(pd.concat([*earlier, pd.DataFrame(rows)[[*COLUMNS]]]), args.ledger)


if __name__ == "__main__":
    main()
