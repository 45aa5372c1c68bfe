"""`wheretolook benchmark`: the Active Localization Benchmark on its own scene folders."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from wheretolook.commands.options import Command
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError, check_range
from wheretolook.utils.processes import cores

METHODS = ("best", "max-visibility", "max-visibility-shipped")


@dataclass(frozen=True, kw_only=True)
class Benchmark(Command):
    """Run the Active Localization Benchmark (ActLoc, 2025): select views, render them, localize the images, score.

    wheretolook benchmark SCENE_DIR [SCENE_DIR ...] [--out FOLDER] [options]
    wheretolook benchmark --errors pose_errors.txt --poses selected_gt_poses.txt [--out FOLDER]

    SCENE_DIR, such as 00010-DBjEcHFg4oq, contains
      scene_reconstruction/    COLMAP model (cameras, images, points3D; binary or text) in metres, z up
        images/                images of the map
      waypoints.txt            "id x y z"; or sampled_waypoints.txt, or name another: --waypoints
      DBjEcHFg4oq.glb          mesh in the frame of the map; or the only .glb of the folder, or name another: --mesh

    docs/benchmark.md describes results, and the differences to the benchmark's own scripts. Results in
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
        max_turn_deg: greatest rotation from a view to the next in degrees: 30 for evaluate_plan.
        localizer: sift, or none: leave it to the benchmark's script.
        workers: processes that map; 0 for one on each core.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
        errors: instead of scenes, an existing pose_errors.txt.
        poses: and its selected_gt_poses.txt.
    """

    POSITIONAL: ClassVar = "scenes"
    SHORT: ClassVar = {"max-turn": "max_turn_deg"}

    scenes: tuple[Path, ...] = ()
    out: Path = Path("benchmark")
    methods: tuple[str, ...] = METHODS
    waypoints: Path | None = None
    mesh: Path | None = None
    weights: Path | None = None
    directions: int = 500
    lattice: Literal["fibonacci", "yaw-pitch"] = "fibonacci"
    max_turn_deg: float | None = None
    localizer: Literal["sift", "none"] = "sift"
    workers: int = 0
    device: str = "auto"
    errors: Path | None = None
    poses: Path | None = None

    def __post_init__(self) -> None:
        if (self.errors is None) != (self.poses is None) or bool(self.scenes) == (self.errors is not None):
            raise ConfigError("the benchmark needs scene folders, or --errors and --poses")
        if len(self.scenes) > 1 and (self.mesh is not None or self.waypoints is not None):
            raise ConfigError("--mesh and --waypoints are of one scene", value=len(self.scenes))
        names = [path.resolve().name for path in self.scenes]
        if len({*names}) < len(names):
            raise ConfigError("two scene folders have the same name", value=names)
        check_range("directions", self.directions, 1)
        check_range("workers", self.workers, 0)
        if self.max_turn_deg is not None:
            check_range("max_turn", self.max_turn_deg, 0)

    def run(self) -> None:
        """Run the benchmark, or score files, and write the report to `out`."""
        from wheretolook_paper.benchmark.files import BenchmarkScene, read_errors, read_poses
        from wheretolook_paper.benchmark.report import NOTES, SUMMARY_CSV, VIEWS_CSV, Result, Scores, write_report

        if self.errors is not None and self.poses is not None:
            scores = Scores.of(read_poses(self.poses), read_errors(self.errors))
            results = [Result(self.errors.resolve().parent.name, self.errors.name, scores)]
        else:
            from wheretolook_paper.benchmark.round import RoundConfig, run_scenes

            config = RoundConfig(
                self.weights,
                self.directions,
                self.lattice,
                self.max_turn_deg,
                localize=self.localizer == "sift",
                workers=self.workers or cores(),
                device=usable_device(self.device),
            )
            scenes = [BenchmarkScene.of(folder, self.mesh, self.waypoints) for folder in self.scenes]
            results = run_scenes(scenes, tuple(dict.fromkeys(self.methods)), self.out, config)
        if not results:
            print("Nothing to score yet. docs/benchmark.md explains how the benchmark's own script continues.")
            return
        print(f"\n{write_report(results, self.out)}\n\n{NOTES}\n")
        print(f"done: {self.out / SUMMARY_CSV}, {self.out / VIEWS_CSV}")
