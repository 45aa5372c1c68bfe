"""`wheretolook benchmark`: the Active Localization Benchmark on its own scene folders."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from wheretolook.commands.options import Command
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.validation import check_range

if TYPE_CHECKING:
    from wheretolook_paper.benchmark.report import Result

METHODS = ("best", "max-visibility", "max-visibility-shipped")


@dataclass(frozen=True, kw_only=True)
class Benchmark(Command):
    """Run the Active Localization Benchmark (ActLoc, 2025): select views, render them, localize the images, score.

    wheretolook benchmark SCENE_DIR [SCENE_DIR ...] [--out FOLDER] [options]
    wheretolook benchmark --errors pose_errors.txt --poses selected_gt_poses.txt [--out FOLDER]

    docs/benchmark.md describes scene folders, results, and the differences to the benchmark's own scripts. Results in
    --out are summary.csv, summary.md, views.csv, and for each scene and method the files of the benchmark's scripts,
    which can continue from any of them. Run again, the same command does only what is missing.

    Methods: best is what the weights select; max-visibility-shipped the benchmark's baseline as it ships, which returns
    its two angles exchanged; max-visibility the same, fixed; any other is a name of `wheretolook evaluate
    --list-methods`.

    Examples:
      wheretolook benchmark 00010-DBjEcHFg4oq
      wheretolook benchmark formatted_training_data/* --methods best --out benchmark
      wheretolook benchmark 00010-DBjEcHFg4oq --waypoints 00010-DBjEcHFg4oq/sampled_waypoints_mini.txt --max-turn 30
      wheretolook benchmark --errors estimate/pose_errors.txt --poses estimate/selected_gt_poses.txt

    Args:
        scenes: scene folders.
        out: folder of the results.
        methods: methods to compare.
        waypoints: other waypoints, of one scene.
        mesh: another mesh, of one scene.
        weights: file or folder of weights; by default the bundled ones.
        directions: number of directions scored at each waypoint.
        lattice: fibonacci (even), or yaw-pitch (ActLoc's 6 x 18).
        max_turn: greatest rotation from a view to the next in degrees: 30 for evaluate_plan.
        localizer: sift, or none: leave it to the benchmark's script.
        workers: processes that map; 0 for one on each core.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
        errors: instead of scenes, an existing pose_errors.txt.
        poses: and its selected_gt_poses.txt.
    """

    POSITIONAL: ClassVar = "scenes"

    scenes: tuple[Path, ...] = ()
    out: Path = Path("benchmark")
    methods: tuple[str, ...] = METHODS
    waypoints: Path | None = None
    mesh: Path | None = None
    weights: Path | None = None
    directions: int = 500
    lattice: Literal["fibonacci", "yaw-pitch"] = "fibonacci"
    max_turn: float | None = None
    localizer: Literal["sift", "none"] = "sift"
    workers: int = 0
    device: str = "auto"
    errors: Path | None = None
    poses: Path | None = None

    def __post_init__(self) -> None:
        if (self.errors is None) != (self.poses is None):
            raise ConfigError("errors and poses belong together", fix="Give both --errors and --poses.")
        if bool(self.scenes) == (self.errors is not None):
            fix = "Give SCENE_DIR, or --errors and --poses."
            raise ConfigError("the benchmark needs scene folders, or files to score", fix=fix)
        if len(self.scenes) > 1 and (self.mesh is not None or self.waypoints is not None):
            raise ConfigError("a mesh and waypoints are of one scene", value=len(self.scenes), fix="Give one scene.")
        names = [path.resolve().name for path in self.scenes]
        if len({*names}) < len(names):
            raise ConfigError("two scene folders have the same name", value=names, fix="Give each once.")
        check_range("directions", self.directions, 1)
        check_range("workers", self.workers, 0)
        if self.max_turn is not None:
            check_range("max_turn", self.max_turn, 0)

    def run(self) -> None:
        """Run the benchmark, or score files, and write the report to `out`."""
        start = time.monotonic()
        results, lines = (_of_files(self), []) if self.errors is not None else _of_scenes(self)
        for line in lines:
            print(line)
        if not results:
            print("Nothing to score yet. docs/benchmark.md explains how the benchmark's own script continues.")
            return
        from wheretolook_paper.benchmark.report import NOTES, SUMMARY_CSV, VIEWS_CSV, write_report

        print(f"\n{write_report(results, self.out)}\n\n{NOTES}\n")
        print(f"done in {time.monotonic() - start:.0f} s: {self.out / SUMMARY_CSV}, {self.out / VIEWS_CSV}")


def _of_files(options: Benchmark) -> list[Result]:
    from wheretolook_paper.benchmark.files import read_errors, read_poses
    from wheretolook_paper.benchmark.report import Result
    from wheretolook_paper.benchmark.scores import Scores

    assert options.poses is not None and options.errors is not None
    scores = Scores.of(read_poses(options.poses), read_errors(options.errors))
    return [Result(options.errors.resolve().parent.name, options.errors.name, scores)]


def _of_scenes(options: Benchmark) -> tuple[list[Result], list[str]]:
    from wheretolook.scorers.registry import check_method
    from wheretolook.utils.devices import usable_device
    from wheretolook_paper.benchmark.actloc_baseline import ACTLOC
    from wheretolook_paper.benchmark.folder import BenchmarkScene
    from wheretolook_paper.benchmark.report import Result
    from wheretolook_paper.benchmark.round import BEST, RoundConfig, SceneRound

    methods = list(dict.fromkeys(options.methods))
    for method in methods:
        if method not in (BEST, ACTLOC):
            check_method(method)
    scenes = [BenchmarkScene.of(folder, options.mesh, options.waypoints) for folder in options.scenes]
    config = RoundConfig(
        options.weights,
        options.directions,
        options.lattice,
        options.max_turn,
        localize=options.localizer == "sift",
        workers=options.workers or len(os.sched_getaffinity(0)),
        device=usable_device(options.device),
    )
    rounds = [SceneRound(scene, options.out / scene.name, config) for scene in scenes]
    results: list[Result] = []
    messages: list[str] = []
    while rounds:
        one = rounds.pop(0)  # so that its mesh goes when it is done
        for method in methods:
            scores = one.run(method)
            if scores is not None:
                results.append(Result(one.scene.name, one.folder_name(method), scores))
        messages += [f"{one.scene.name}: {line}" for line in one.messages]
    return results, messages
