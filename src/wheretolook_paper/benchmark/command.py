"""`wheretolook benchmark`: the Active Localization Benchmark on its own scene folders. It needs no configuration."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.options import CommandParser

if TYPE_CHECKING:
    from wheretolook_paper.benchmark.report import Result

ABOUT = "The Active Localization Benchmark (of ActLoc, 2025): select views, draw them, localize the images, score."

USAGE = """\
wheretolook benchmark SCENE_DIR [SCENE_DIR ...] [--out FOLDER] [options]
       wheretolook benchmark --errors pose_errors.txt --poses selected_gt_poses.txt [--out FOLDER]"""

METHODS = ("best", "max-visibility", "max-visibility-shipped")

_NOTES = """\
SCENE FOLDER, as the benchmark's example scene and its full dataset (formatted_training_data/<scene>)
  {layout}

WHAT COMES OUT, in --out
  summary.csv, summary.md    of each scene and method: share of views within 5 cm and 0.4 degrees, 25 cm and 2, 50 cm
                             and 5, 5 m and 10 (evaluate_loc), and within 25 cm and 2 degrees after a turn of at most
                             30 from the view before (evaluate_plan); as shipped beside mended
  views.csv                  each view: where it looks, its error, its turn, in which measures it counts
  <scene>/<method>/          selected_gt_poses.txt, images/, estimate_poses.txt, pose_errors.txt, by the names and in
                             the formats of the benchmark's scripts, which can go on from any of them
  <scene>/map/               SIFT landmarks that images are localized against
  Done again, the same command does only what is missing.

METHODS (--methods)
  best                       what the weights select (--weights, or those that ship)
  max-visibility-shipped     the benchmark's baseline as it ships: it returns its two angles exchanged
  max-visibility             the same mended: angles in their order, elevation from level, upright
  any other                  `wheretolook evaluate --list-methods`

AS ACTLOC AND ACTLOC_FIXED
  evaluate_plan.py joins errors to poses by row, though errors stand in the order of file names (1, 10, 2) and poses in
  that of waypoints; as shipped is what it computes on these files. Mended joins by id.

WHAT DIFFERS FROM THE BENCHMARK, AND WHAT COULD NOT BE TRIED
  Its data could not be had where this was written: the round was tried on generated scenes in its layout, the measures
  against its published definitions. Its localizer (SuperPoint, LightGlue, every image of the map, hloc) is not
  part of this package: here SIFT is triangulated in the map's images at the map's poses, and PoseLib localizes, 12 px
  as there. Its images are drawn with Open3D, here with a renderer of our own; the image's camera is the same. To have
  the benchmark's own localizer:
    wheretolook benchmark SCENE_DIR --localizer none     then, for each method, its
    match_and_localize.py --query_images_path OUT/<scene>/<method>/images
      --poses_fn OUT/<scene>/<method>/selected_gt_poses.txt --output_path OUT/<scene>/<method> ...
    wheretolook benchmark SCENE_DIR --localizer none     again: it scores what the script wrote

EXAMPLES
  wheretolook benchmark 00010-DBjEcHFg4oq
  wheretolook benchmark formatted_training_data/* --methods best --out benchmark
  wheretolook benchmark 00010-DBjEcHFg4oq --waypoints 00010-DBjEcHFg4oq/sampled_waypoints_mini.txt --max-turn 30
  wheretolook benchmark --errors estimate/pose_errors.txt --poses estimate/selected_gt_poses.txt"""


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    from wheretolook_paper.benchmark.folder import LAYOUT

    made = CommandParser(
        prog="wheretolook benchmark",
        usage=USAGE,
        description=ABOUT,
        epilog=_NOTES.format(layout=LAYOUT.replace("\n", "\n  ")),
    )
    add = made.add_argument
    add("scenes", nargs="*", type=Path, metavar="SCENE_DIR", help="scene folders")
    add("--out", type=Path, default=Path("benchmark"), metavar="FOLDER", help="where results go (benchmark)")
    add("--methods", nargs="+", default=list(METHODS), metavar="NAME", help=f"what is compared ({' '.join(METHODS)})")
    add("--waypoints", type=Path, metavar="FILE", help="other waypoints, of one scene")
    add("--mesh", type=Path, metavar="FILE", help="another mesh, of one scene")
    select = made.add_argument_group("how views are selected, but for the benchmark's baseline")
    add = select.add_argument
    add("--weights", type=Path, metavar="FILE", help="weights, or a folder of them (those that ship)")
    add("--directions", type=int, default=500, metavar="N", help="directions looked along at each waypoint (500)")
    add("--lattice", default="fibonacci", metavar="NAME", help="fibonacci (even), or yaw-pitch (ActLoc's 6 x 18)")
    add("--max-turn", type=float, metavar="DEG", help="greatest rotation from a view to the next: 30 for evaluate_plan")
    work = made.add_argument_group("how images are localized")
    add = work.add_argument
    add("--localizer", default="sift", metavar="NAME", help="sift, or none: leave it to the benchmark's script (sift)")
    add("--workers", type=int, default=0, metavar="N", help="processes that map; 0 for one on each core (0)")
    add("--device", default="auto", metavar="NAME", help="auto, cpu, cuda, cuda:1 (auto)")
    files = made.add_argument_group("instead of scenes: score files that are there")
    add = files.add_argument
    add("--errors", type=Path, metavar="FILE", help="pose_errors.txt")
    add("--poses", type=Path, metavar="FILE", help="selected_gt_poses.txt")
    return made


def run(arguments: Sequence[str]) -> int:
    """Run the command. Returns the exit code 0; raises a WhereToLookError for bad input."""
    options = parser().parse_args(arguments)
    _check(options)
    start = time.monotonic()
    results, told = (_of_files(options), []) if options.errors is not None else _of_scenes(options)
    for line in told:
        print(line)
    if not results:
        print("Nothing to score yet. `wheretolook benchmark --help` tells how the benchmark's own script goes on.")
        return 0
    from wheretolook_paper.benchmark.report import NOTES, SUMMARY_CSV, VIEWS_CSV, write_report

    print(f"\n{write_report(results, options.out)}\n\n{NOTES}\n")
    print(f"done in {time.monotonic() - start:.0f} s: {options.out / SUMMARY_CSV}, {options.out / VIEWS_CSV}")
    return 0


def _check(options: argparse.Namespace) -> None:
    """Refuse what can be refused before anything is read."""
    from wheretolook.geometry.lattices import LATTICES

    if (options.errors is None) != (options.poses is None):
        raise ConfigError("errors and poses belong together", fix="Give both --errors and --poses.")
    if bool(options.scenes) == (options.errors is not None):
        fix = "Give SCENE_DIR, or --errors and --poses; `wheretolook benchmark --help` tells what a scene folder holds."
        raise ConfigError("the benchmark needs scene folders, or files to score", fix=fix)
    if len(options.scenes) > 1 and (options.mesh is not None or options.waypoints is not None):
        raise ConfigError("a mesh and waypoints are of one scene", value=len(options.scenes), fix="Give one scene.")
    names = [path.resolve().name for path in options.scenes]
    if len({*names}) < len(names):
        raise ConfigError("two scene folders have the same name", value=names, fix="Give each once.")
    if options.localizer not in ("sift", "none"):
        raise ConfigError("unknown localizer", value=options.localizer, fix="There are sift and none.")
    if options.lattice not in LATTICES:
        raise ConfigError("unknown lattice", value=options.lattice, fix=f"There are {', '.join(LATTICES)}.")
    if options.directions < 1 or options.workers < 0:
        value = (options.directions, options.workers)
        raise ConfigError("--directions is at least 1, --workers at least 0", value=value)
    if options.max_turn is not None and not options.max_turn >= 0:
        raise ConfigError("a limit on turns is at least 0 degrees", value=options.max_turn)


def _of_files(options: argparse.Namespace) -> list[Result]:
    from wheretolook_paper.benchmark.files import read_errors, read_poses
    from wheretolook_paper.benchmark.report import Result
    from wheretolook_paper.benchmark.scores import Scores

    scores = Scores.of(read_poses(options.poses), read_errors(options.errors))
    return [Result(options.errors.resolve().parent.name, options.errors.name, scores)]


def _of_scenes(options: argparse.Namespace) -> tuple[list[Result], list[str]]:
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
    told: list[str] = []
    while rounds:
        one = rounds.pop(0)  # so that its mesh goes when it is done
        for method in methods:
            scores = one.run(method)
            if scores is not None:
                results.append(Result(one.scene.name, one.folder_name(method), scores))
        told += [f"{one.scene.name}: {line}" for line in one.messages]
    return results, told
