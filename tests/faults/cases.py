"""Every stage and command on a tiny dataset: what it is called with, from which state of the files."""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import subprocess
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from faults.runs import at_file_events, contents, run
from wheretolook.holdout.photo_map import WORK

EXPERIMENT = """\
name: tiny
camera: {width: 240, height: 180, focal_px: 120}
scenes:
  train: 0
  test: 0
  meshes: [{path: one.glb, split: train}, {path: two.glb, split: test}]
map: {n_images: 12, keep_images: true}
sample: {grid: [5, 5, 3], directions: 40, keep: 20, max_locations: 4, max_directions: 4}
label: {workers: 2, shard_size: 4}
train: {val_fraction: 0.3, methods: [mlp-2d], mlp: {epochs: 1}}
evaluate: {resamples: 10, top_n: [1], methods: [random, visible, bins, mlp]}
"""

GENERATED = ["--scenes.train", "1", "--scenes.meshes", "[]", "--scenes.apartment.n_rooms", "3",
             "--scenes.apartment.area_m2", "26", "--scenes.apartment.texture_size", "1024",
             "--scenes.apartment.texels_per_m", "40", "--scenes.apartment.light_spacing_m", "1.0",
             "--scenes.apartment.light_rays", "4"]  # fmt: skip
MAP = "data/tiny/two/map"
PATHS = ["--paths.pairs", "1", "--paths.methods", "[forward,visible]", "--paths.grid", "[4,4,2]",
         "--paths.directions", "20", "--paths.min_distance_m", "0.5", "--paths.planner.time_s", "4",
         "--paths.planner.spacing_m", "0.5", "--paths.max_turn_deg", "60"]  # fmt: skip
SPACE = ["--scene", "two", "--method", "visible", "--viewpoint_map.grid", "[4,4,2]", "--viewpoint_map.directions", "20"]
VARYING = (
    "*/map/report.json",
    "*/photos/room/map/*",
    "*/weights/*.json",
    "*/path/*",
    "*/room/photographs/*",
    "*/paths/*",
    "*/paths.*",
    "*/scores.md",
    "*/compared.json",
)
"""Files that hold run ids or the seconds that steps took, or paths that are planned against the clock, or a map of
photographs, whose last digits depend on how COLMAP's threads share the work: of it, `_counts` are compared."""


@dataclass(frozen=True, eq=False)
class Case:
    """A command that is disturbed.

    Attributes:
        name: what it is called in the report.
        before: name of the state of the files that it starts from.
        arguments: what is disturbed.
        after: name of the state that it leads to, undisturbed.
        again: what is run afterwards, if it is another command than the one disturbed.
        workers: whether it starts processes.
    """

    name: str
    before: str
    arguments: list[str]
    after: str = ""
    again: list[str] = field(default_factory=list)
    workers: bool = False

    @property
    def rerun(self) -> list[str]:
        return self.again or self.arguments


def stage(name: str, *options: str, of: str = "tiny.yaml") -> list[str]:
    return [name, "--config", of, "--data", "data", "--tracking.folder", "mlruns", "--device", "cpu", *options]


CORRIDOR = ("--map", "corridor/sparse", "--database", "corridor/features.db")
CHECK = ["check", *CORRIDOR, "--metres", "--views", "6", "--device", "cpu", "--workers", "2"]
SYNTHETIC = ("--name", "synthetic", "--scene", "scene-1", "--camera.width", "160", "--camera.height", "120",
             "--camera.focal_px", "80")  # fmt: skip
TWO = ("--label.workers", "2")
ONE = ("--label.workers", "1")

LINE = (
    Case("scenes", "empty", stage("scenes"), "scenes"),
    Case("map", "scenes", stage("map", *TWO), "map", workers=True),
    Case("sample", "map", stage("sample"), "sample"),
    Case("label", "sample", stage("label"), "label", workers=True),
    Case("train", "label", stage("train"), "train"),
    Case("evaluate", "train", stage("evaluate"), "evaluate"),
)
"""The stages in order: each starts from where the one before it has led."""

OTHERS = (
    Case("scenes, generated", "empty", stage("scenes", "--name", "made", *GENERATED)),
    Case("map --images", "evaluate", stage(
        "map", "--name", "photos", "--images", "photographs", "--map.photographs.name", "room",
        "--camera.width", "240", *TWO), workers=True),
    Case("map --model", "evaluate", stage(
        "map", "--name", "own", "--model", MAP, "--mesh", "data/tiny/two/mesh.glb",
        "--map.existing.name", "room", *ONE)),
    Case("train, two processes", "label", stage(
        "train", "--train.methods", "[mlp-2d]", "--train.devices", "2", "--train.accelerator", "cpu"), workers=True),
    Case("viewpoint-map", "evaluate", stage("viewpoint-map", *SPACE)),
    Case("plan", "evaluate", stage(
        "plan", "--scene", "two", "--method", "visible", "--start", "[1,1,1.2]", "--goal", "[2.6,2,1.2]",
        "--plan.grid", "[4,4,2]", "--plan.directions", "20", "--plan.planner.time_s", "4", "--film", "none")),
    Case("figures", "evaluate", stage("figures", "--only", "[scores]", "--kinds", "[svg]", "--out", "figures")),
    Case("compare-paths", "evaluate", stage("compare-paths", *PATHS, *TWO), workers=True),
    Case("release", "evaluate", stage("release")),
    Case("demo", "map", stage("demo"), workers=True),
    Case("select", "evaluate", ["select", "--map", MAP, "--at", "1,1,1.2", "2,1,1.2", "--out", "views.csv",
                                "--directions", "20"]),
    Case("export", "evaluate", ["export", "--map", MAP, "--out", "robot"]),
    Case("check", "corridor", CHECK, workers=True),
    Case("check --images", "photographs", [
        "check", "--map", "sparse", "--images", "photographs", "--metres", "--views", "4", "--device", "cpu",
        "--workers", "2"], workers=True),
    Case("adapt --map", "corridor", stage("adapt", *CORRIDOR, *TWO), workers=True),
    Case("adapt, labels that are there", "labelled", stage("adapt", *SYNTHETIC)),
    Case("sample, more", "map", stage("sample", "--sample.max_locations", "12", "--sample.max_directions", "10")),
    Case("adapt, labels of its own", "sample, more", stage("adapt", "--scene", "two", *TWO), workers=True),
)  # fmt: skip
"""What comes beside or after the line."""

CHANGED = (
    Case("scenes, turned", "scenes", stage("scenes", "--scenes.meshes", "[{path: one.glb, split: train, up: -z}]"),
         "scenes", stage("scenes")),
    Case("map, fewer images", "map", stage("map", "--map.n_images", "10", *ONE), "map", stage("map", *ONE)),
    Case("sample, another seed", "sample", stage("sample", "--sample.seed", "5"), "sample", stage("sample")),
    Case("label, another threshold", "label", stage("label", "--label.localizer.max_error_px", "3"), "label",
         stage("label"), workers=True),
    Case("train, another seed", "train", stage("train", "--train.seed", "7"), "train", stage("train")),
    Case("viewpoint-map over another", "viewpoint-map", stage(
        "viewpoint-map", *SPACE, "--viewpoint_map.directions", "30"), "viewpoint-map",
        stage("viewpoint-map", *SPACE)),
)  # fmt: skip
"""Finished, then begun with other settings and disturbed, then run with the first settings again."""


class Workshop:
    """The states of the files that cases start from, and what an undisturbed run of each leaves."""

    def __init__(self, root: Path, say: Callable[[str], None] = print) -> None:
        self.root = root
        self.say = say
        self.folder = root / "work" / "run"  # the same path in every job: records of what was made hold it
        self.folder.parent.mkdir(parents=True)
        self.expected: dict[str, dict[str, str]] = {}
        self.seconds: dict[str, float] = {}
        self.events: dict[str, int] = {}
        self.broken: list[str] = []  # what did not even run undisturbed

    def own_folder(self) -> None:
        """From now on `folder` is this process's own, though other jobs have one at the same path; needs root."""
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.unshare(0x00020000) != 0:  # CLONE_NEWNS
            raise OSError(ctypes.get_errno(), "cannot have mounts of its own")
        subprocess.run(["mount", "--make-rprivate", "/"], check=True)
        subprocess.run(["mount", "-t", "tmpfs", "tmpfs", str(self.folder.parent)], check=True)

    def state(self, name: str) -> Path:
        return self.root / "states" / name.replace(" ", "_")

    def restore(self, name: str) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.state(name), self.folder)

    def make(self, cases: Sequence[Case]) -> None:
        """Run the stages as far as the cases need them, and each case without disturbing it."""
        self.state("empty").mkdir(parents=True)
        if os.waitstatus_to_exitcode(os.waitpid(self._fork(self._begin), 0)[1]) != 0:
            raise RuntimeError("the meshes and the MLflow store could not be made")
        wanted = {case.before for case in cases} | {case.after for case in cases}
        cases = [*(case for case in OTHERS if case.name in wanted), *cases]
        wanted |= {case.before for case in cases}
        last = max((number for number, case in enumerate(LINE) if case.after in wanted), default=-1)
        for case in dict.fromkeys([*LINE[: last + 1], *cases]):
            try:
                self._undisturbed(case)
            except (RuntimeError, TimeoutError) as error:
                if case in LINE:
                    raise
                self.broken.append(f"{case.name}, undisturbed: {error}")
                self.say(self.broken[-1])

    def _fork(self, function: Callable[[], None]) -> int:
        pid = os.fork()
        if pid == 0:
            try:
                function()
                os._exit(0)
            except BaseException:
                traceback.print_exc()
                os._exit(1)
        return pid

    def _begin(self) -> None:
        from dataclasses import replace

        import numpy as np

        from mapping.conftest import box_room
        from wheretolook.scenes.loading import save_glb
        from wheretolook.tracking.config import TrackingConfig
        from wheretolook.tracking.store import client

        first = self.state("empty")
        (first / "tiny.yaml").write_text(EXPERIMENT)
        for seed, name in enumerate(("one", "two")):
            mesh = box_room((4.0, 3.5, 2.5), seed)
            textures = [
                np.full_like(texture, 200) if face == 1 else texture for face, texture in enumerate(mesh.textures)
            ]
            save_glb(replace(mesh, textures=tuple(textures)), first / f"{name}.glb")
        client(TrackingConfig(str(first / "mlruns")))
        for name, make in (("corridor", _corridor), ("photographs", _photographs), ("labelled", _labelled)):
            shutil.copytree(first, self.state(name))
            make(self.state(name))

    def _undisturbed(self, case: Case) -> None:
        """Run a case; count its changes of files, at which it may be killed."""
        counter = self.root / "events"
        counter.write_bytes(b"")

        def note(_: int) -> None:
            file = os.open(counter, os.O_WRONLY | os.O_APPEND)
            os.write(file, b".")
            os.close(file)

        self.restore(case.before)
        start = time.monotonic()
        one = run(self.folder, case.arguments, at_file_events(self.folder, note))
        if one.code != 0:
            raise RuntimeError(f"{case.name}: exit code {one.code}\n{one.out[-2000:]}\n{one.err[-4000:]}")
        self.seconds[case.name] = time.monotonic() - start
        self.events[case.name] = counter.stat().st_size
        self.say(f"{case.name}: {self.seconds[case.name]:.1f} s, {self.events[case.name]} changes of files")
        if not case.again:
            name = case.after or case.name
            shutil.copytree(self.folder, self.state(name))
            if name == "map":  # photographs of a scene: the images that its map was made of
                shutil.copytree(self.folder / MAP / "images", self.state(name) / "photographs")
            self.expected[name] = contents(self.folder)

    def differences(self, case: Case) -> list[str]:
        """In which files the folder differs from what an undisturbed run leaves."""
        found = _one_name(contents(self.folder))
        expected = _one_name(self.expected[case.after or case.name])
        if case.before == "map" and case.after == "map":  # which holds photographs for others
            found = {path: digest for path, digest in found.items() if not path.startswith("photographs/")}
        made = [
            path for path in {*found, *expected} if not fnmatch(path, "*/paths/*/shards/*.parquet")
        ]  # of such paths
        found, expected = ({path: files[path] for path in made if path in files} for files in (found, expected))
        missing = [f"missing: {path}" for path in sorted({*expected} - {*found})]
        left = [f"left over: {path}" for path in sorted({*found} - {*expected})]
        fixed = [path for path in expected if not any(fnmatch(f"/{path}", pattern) for pattern in VARYING)]
        other = [f"other: {path}" for path in fixed if found.get(path, expected[path]) != expected[path]]
        counts = [_counts(folder) for folder in (self.folder, self.state(case.after or case.name))]
        return missing + left + other + [f"other counts: {counts}"] * (counts[0] != counts[1])


def _one_name(files: dict[str, str]) -> dict[str, str]:
    """Files with one name for the only folder of blocks, which tells when features were made: of photographs, now."""
    blocks = [found[0] for path in files if (found := re.search(rf"(?<=/{WORK}/blocks-)\w+(?=/)", path))]
    if len({*blocks}) != 1:
        return files
    return {path.replace(blocks[0], "key"): digest for path, digest in files.items()}


def _corridor(folder: Path) -> None:
    """A map of 30 photographs, and their features."""
    from check.corridor import write_corridor

    write_corridor(folder / "corridor")


def _photographs(folder: Path) -> None:
    """A model of poses alone, and its photographs: 24, rendered."""
    from check.rendered_room import write_rendered_room

    write_rendered_room(folder)


def _labelled(folder: Path) -> None:
    """A dataset of two labelled scenes, whose labels are made up."""
    from synthetic_dataset import make_dataset

    for scene in make_dataset(folder / "data" / "synthetic", ("train", "test")).scenes:
        scene.stage_cache("label", "key").store()


def _counts(folder: Path) -> dict[str, Any]:
    """What the report of a map of photographs counts; nothing if there is no such map."""
    report = folder / "data" / "photos" / "room" / "map" / "report.json"
    content = json.loads(report.read_text()) if report.exists() else {}
    counted = ("n_images", "n_registered", "model_sizes", "n_keypoints", "n_landmarks")
    return {name: content[name] for name in counted if name in content}
