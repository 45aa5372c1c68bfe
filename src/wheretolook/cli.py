"""The command line: `wheretolook STAGE --config configs/demo.yaml`, one sub-command for each stage."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from wheretolook.utils.errors import (
    ConfigError,
    LockWarning,
    MapWarning,
    OutOfRangeWarning,
    TrackingWarning,
    WhereToLookError,
)
from wheretolook.utils.options import Option, all_options, check_names, grouped, names_in, nearest, short_lines
from wheretolook.utils.shipped import or_shipped, shipped, shipped_configs
from wheretolook.utils.version import VERSION

if TYPE_CHECKING:
    from wheretolook.config import Experiment


@dataclass(frozen=True)
class Stage:
    """What the command line knows of a stage."""

    function: str  # in `wheretolook.stages`
    text: str  # what it does
    matter: str  # options that `--help` shows, with blanks between; one without a dot may be short
    groups: tuple[str, ...] = ()  # `--help-all` shows the options in these groups; none for all
    example: str = "--config configs/demo.yaml"  # arguments to try
    short: Mapping[str, str] = field(default_factory=dict)  # flags that may be given without their group
    config: str = ""  # name of the file in configs/ that is read unless --config names one
    notes: str = ""  # what else to know


_SPACE = ("occlusion", "scenes.free_space", "scenes.mapped_space", "map.photographs.assume_metric")

STAGES = {
    "scenes": Stage(
        "make_scenes",
        "Make or load the textured meshes, or fuse one from colour and depth images: --rgbd.",
        "scenes.train scenes.val scenes.test scenes.seed scenes.meshes scenes.apartment.n_rooms "
        "scenes.apartment.area_m2 scenes.apartment.texture_richness scenes.apartment.clutter scenes.apartment.vary "
        "rgbd up",
        ("scenes",),
        "--config configs/demo.yaml --scenes.train 5\n  wheretolook scenes --name kitchen --rgbd FOLDER",
        {"--rgbd": "--scenes.rgbd.folder", "--up": "--scenes.rgbd.up"},
    ),
    "map": Stage(
        "make_maps",
        "Build a COLMAP map of every scene by renders, or of photographs: --images. Or take one of your own: --model.",
        "model mesh database images map.existing.name map.n_images map.extractor.method "
        "map.photographs.name map.photographs.scale.positions label.workers",
        ("map", "scenes.free_space", "label.workers"),
        "--name photos --images FOLDER",
        {f"--{name}": f"--map.existing.{name}" for name in ("model", "mesh", "database")},
        notes="""\
A model of your own, from COLMAP or hloc, in metres with z up, becomes a scene for sample, viewpoint-map and plan:
  wheretolook map --name mymap --model sparse/0 --mesh scan.glb --database database.db
Mesh and database may be left out. With --images its landmarks are triangulated anew. Not upright, or not in metres?
--map.existing.level true, --map.photographs.scale.positions FILE. Its own camera looks, unless --camera names one.""",
    ),
    "sample": Stage(
        "sample",
        "Choose viewpoints by the landmarks they see.",
        "sample.grid sample.directions sample.lattice sample.keep sample.min_visible sample.max_locations "
        "sample.max_directions sample.seed occlusion.model scenes.free_space.clearance_m",
        ("sample", *_SPACE),
        "--config configs/demo.yaml --sample.max_locations 100",
    ),
    "label": Stage(
        "label",
        "Render and localize every viewpoint, measure the pose error. Resumes.",
        "engine label.ray_address label.workers label.shard_size label.store_matches label.store_pixels "
        "label.localizer.max_ratio label.localizer.lightglue label.localizer.max_error_px label.localizer.min_inliers "
        "tracking.folder",
        ("label", "tracking"),
        "--config configs/paper.yaml --engine ray",
    ),
    "train": Stage(
        "train",
        "Learn from the labels, one weights file for each method.",
        "train.methods train.also train.val_fraction train.seed train.accelerator train.devices train.mlp.epochs "
        "train.mlp.batch_size train.mlp.balance train.set.epochs tracking.folder",
        ("train", "tracking"),
        "--config configs/demo.yaml --train.methods '[mlp-2d+z, set]'",
    ),
    "evaluate": Stage(
        "evaluate",
        "Score all methods on the test scenes.",
        "evaluate.methods evaluate.weights evaluate.split evaluate.top_n evaluate.thresholds evaluate.occlusions "
        "evaluate.candidates evaluate.photographs evaluate.reference evaluate.seed tracking.folder",
        ("evaluate", "occlusion", "tracking"),
        "--config configs/demo.yaml --evaluate.methods '[random, visible, set]'",
        notes="What evaluate.methods may name: wheretolook evaluate --list-methods",
    ),
    "adapt": Stage(
        "adapt",
        "Adapt the weights that ship to one place, by views localized there; kept only if that makes them better.",
        "scene map images database weights out minutes adapt.seed label.workers tracking.folder",
        ("adapt", *_SPACE, "label", "tracking"),
        "--map sparse/0 --database database.db\n  "
        "wheretolook adapt --config configs/demo.yaml --scene apartment-000 --minutes 5",
        {
            f"--{name}": f"--adapt.{name}"
            for name in ("scene", "map", "images", "database", "weights", "out", "minutes")
        },
        notes="""\
Learns from the map's own photographs, left out in blocks as `wheretolook check` does, of a COLMAP model (--map) or of a
scene made of photographs; and from a scene's labels, or, where it has a mesh and none, from as many of its viewpoints
as can be labelled in the minutes; done again, it goes on with more. The weights are for this place alone:
  wheretolook select --map sparse/0 --weights data/checks/mymap/adapted.safetensors --at 1,2,1.4 --out views.csv""",
    ),
    "viewpoint-map": Stage(
        "viewpoint_map",
        "Score every direction at every free voxel of a scene, for planners to look up. Needs no labels.",
        "scene method weights out viewpoint_map.grid viewpoint_map.directions viewpoint_map.lattice occlusion.model",
        ("viewpoint_map", *_SPACE),
        """--config configs/demo.yaml --scene apartment-000 \\
      --weights data/release/weights/mlp-2d+z.safetensors --out apartment.map""",
        {f"--{name}": f"--viewpoint_map.{name}" for name in ("scene", "method", "weights", "out")},
        notes="""\
Reads a scene's map and its mesh, as the scenes and map stages leave them; a scene of photographs has no mesh, and is
free where scenes.mapped_space says. Without weights or a method, the best weights of the dataset, or else those that
ship, score the views. The folder holds plain arrays and LAYOUT.txt, which says how to read them; in Python:

  from wheretolook import ViewpointMap
  viewpoint_map = ViewpointMap.load("apartment.map", mmap=True)
  choice = viewpoint_map.best((1.0, 2.0, 1.5))    # None where no camera can be, else axis, score, n_visible""",
    ),
    "plan": Stage(
        "plan",
        "Plan a path on which the camera sees what it needs to know where it is; a table, a picture and a film of it.",
        "scene start goal method weights out film plan.against plan.rerun plan.planner.time_s "
        "plan.planner.score_weight occlusion.model",
        ("plan", *_SPACE, "tracking"),
        """--config configs/demo.yaml --scene apartment-000 --start '[-4, -3, 1.4]' --goal '[4, 3, 1.4]' \\
      --plan.against '[forward]' --film mp4 --out way""",
        {f"--{name}": f"--plan.{name}" for name in ("scene", "start", "goal", "method", "weights", "out", "film")},
        notes="""\
Reads a scene's map and its mesh, if it has one, as the scenes and map stages leave them.
To plan in what depth images saw as free, without the mesh: --occlusion.model tsdf""",
    ),
    "compare-paths": Stage(
        "compare_paths",
        "Plan paths between random places by several methods, render what the camera sees, localize it. Resumes.",
        "paths.scenes paths.pairs paths.methods paths.weights paths.seed paths.min_distance_m paths.planner.time_s "
        "paths.planner.score_weight occlusion.model label.workers tracking.folder",
        ("paths", "occlusion", "scenes.free_space", "label", "tracking"),
        "--config configs/demo.yaml --paths.methods '[forward, set]' --paths.pairs 5",
    ),
    "release": Stage(
        "release",
        "Make a compact copy, data/release; given that copy and weights trained on it, evaluate and write its card.",
        "release_name evaluate.methods evaluate.occlusions evaluate.candidates tracking.folder",
        ("evaluate", "occlusion", "tracking"),
        "--config configs/release.yaml",
    ),
    "log-release": Stage(
        "log_release",
        "Log what a release ships as MLflow runs, as if it had been made here; once.",
        "tracking.folder tracking.experiment",
        ("tracking",),
        "--tracking.folder elsewhere",
        config="release",
        notes="""\
A release ships its tables, not an MLflow store. This logs them into one, in seconds: an evaluation with its nested
runs, a train run for each weights record, the comparison of learners, planned paths and measured times. Done again, it
adds only what is new; `make ui` does it first. Without --config it is configs/release.yaml.""",
    ),
    "figures": Stage(
        "figures",
        "Draw every figure and table of the paper, and others, from logged runs.",
        "out only kinds tracking.folder",
        ("figures", "tracking"),
        "--only '[top_n, runtimes]' --kinds '[svg]'",
        {f"--{name}": f"--figures.{name}" for name in ("out", "only", "kinds")},
        config="release",
        notes="""\
`wheretolook figures --list` tells what there is, of the paper and beyond. Each file says which runs it was drawn from,
and is attached to them as an artifact under figures/. Where a run is missing, the command that makes it is named and
the others are drawn; if one of the paper's, or one of those named with --only, is missing, the exit code is 2.
Without --config it is configs/release.yaml, whose runs are logged first. Tables are CSV, Markdown and TeX.""",
    ),
    "demo": Stage(
        "",
        "Run all stages on the embedded default and draw the score figure.",
        "scenes.train scenes.test scenes.meshes map.n_images sample.max_locations sample.max_directions label.workers "
        "train.methods train.mlp.epochs evaluate.methods evaluate.weights tracking.folder",
        example="--name small --scenes.train 2",
        config="demo",
        notes="Without --config it is configs/demo.yaml.",
    ),
}
"""The sub-commands, in the order of the line of stages."""

OWN = {
    "select": ("wheretolook.select.command", "The best views at places of your own COLMAP model; needs no dataset."),
    "check": ("wheretolook.check.command", "How well views of your own map are told apart, by its own photographs."),
    "view": ("wheretolook.view.command", "A scene or your own map in the browser, with the score of every view."),
    "export": ("wheretolook.robot.command", "What a robot needs to score views of your own map, without PyTorch."),
    "benchmark": ("wheretolook.benchmark.command", "The Active Localization Benchmark on its scene folders."),
}
"""Sub-commands with options of their own, which are no stages of an experiment: their module, and what they do."""

_SHORT = {"--engine": "--label.engine", "--images": "--map.photographs.images"}  # flags of every stage
_SIGNED = ("--up", "--scenes.rgbd.up", "--map.existing.mesh_up")  # flags whose value may begin with a minus sign
_COMMON = "name data device"  # the options that matter to every stage

USAGE = """\
wheretolook: where to point a camera so that it knows where it is

usage: wheretolook STAGE [--config FILE.yaml] [--GROUP.SETTING VALUE ...] [--debug]

stages, in order; each reads what the one before it left in <data>/<name>/
{stages}

of your own map, without a dataset:
{own}

  wheretolook select --map sparse/0 --at waypoints.csv --out views.csv
  wheretolook check --map sparse/0 --database database.db
  wheretolook export --map sparse/0 --out FOLDER
  wheretolook STAGE --help         the options that matter to a stage, with their defaults
  wheretolook STAGE --help-all     every option it reads
  wheretolook demo                 is configs/demo.yaml unless --config names another
  wheretolook map --config configs/demo.yaml --map.n_images 120
  wheretolook scenes --name scan --rgbd FOLDER        a scene from colour and depth images with poses
  wheretolook map --name photos --images FOLDER       a scene known from photographs alone
  wheretolook map --name mymap --model sparse/0       a scene from a COLMAP model of your own
  wheretolook label --config configs/paper.yaml --engine ray     on a Ray cluster; the default is local
  wheretolook evaluate --list-methods    what can be compared
  wheretolook viewpoint-map --config configs/demo.yaml --scene apartment-000 --out room.map
  wheretolook figures --list             figures and tables of the paper; `wheretolook figures` draws them
  wheretolook --version
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Returns the exit code: 0, 2 for bad input, 130 when interrupted."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads leave the core to other processes
    os.environ.setdefault("GLOG_logtostderr", "1")  # COLMAP leaves no log files in the folder of temporary files
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        stages = "\n".join(f"  {name:<15}{stage.text}" for name, stage in STAGES.items())
        own = "\n".join(f"  {name:<15}{text}" for name, (_, text) in OWN.items())
        print(USAGE.format(stages=stages, own=own))
        return 0
    if arguments[0] == "--version":
        print(f"wheretolook {VERSION}")
        return 0
    interrupts: list[int] = []
    try:
        with _noting(interrupts):
            if not debug:
                _quieten()
            return _run(arguments[0], arguments[1:])
    except (Exception, KeyboardInterrupt) as error:
        if interrupts or isinstance(error, KeyboardInterrupt):
            said = "interrupted; what is finished is kept, run the same command to go on"
            print(f"\nwheretolook: {said}", file=sys.stderr)
            return 130
        if not isinstance(error, WhereToLookError | OSError):
            raise
        if debug:
            traceback.print_exc()
        text = f"{error.filename or 'a file'}: {error.strerror or error}" if isinstance(error, OSError) else str(error)
        print(f"wheretolook: error: {text}", file=sys.stderr)
        return 2


@contextmanager
def _noting(interrupts: list[int]) -> Iterator[None]:
    """Note each Ctrl-C in this block: compiled libraries, such as the one that reads weights, make errors of it."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler or not _in_main_thread():
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        signal.default_int_handler(number, frame)

    def interrupt_again(lost: sys.UnraisableHookArgs) -> None:
        if lost.exc_type is KeyboardInterrupt:  # it came while an object was removed, where Python drops errors
            main_thread = threading.main_thread().ident or 0  # a real signal, which also ends what waits
            later.append(threading.Timer(0.01, signal.pthread_kill, (main_thread, signal.SIGINT)))
            later[-1].start()
        else:
            usual(lost)

    later: list[threading.Timer] = []
    usual, sys.unraisablehook = sys.unraisablehook, interrupt_again
    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = usual
        for timer in later:
            timer.cancel()


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _run(command: str, arguments: list[str]) -> int:
    if command in OWN:
        return int(import_module(OWN[command][0]).run(arguments))
    if command not in STAGES:
        near = nearest(command, [*STAGES, *OWN])
        fix = f"Did you mean {near}?" if near else f"Use one of {', '.join([*STAGES, *OWN])}."
        raise ConfigError("unknown stage", value=command, fix=fix)
    if command == "evaluate" and "--list-methods" in arguments:
        from wheretolook.methods.registry import describe_methods

        texts = describe_methods()
        width = max(map(len, texts))
        print("\n".join(f"{name:<{width}}  {text}" for name, text in texts.items()))
        return 0
    if command == "figures" and "--list" in arguments:
        from wheretolook.release.catalog import catalog_text

        print(catalog_text())
        return 0
    experiment = parse_experiment(command, arguments)
    if experiment is None:
        return 0
    if experiment.device != "auto":
        _ = experiment.warp_device  # refused now if it is not there, not after hours of other work
    from wheretolook import stages

    if command == "demo":
        from wheretolook.stages.demo import run_demo

        run_demo(experiment)
    else:
        start = time.monotonic()
        getattr(stages, STAGES[command].function)(experiment)
        where = f": {experiment.root}" if experiment.root.is_dir() else ""  # of a map alone there is no dataset
        print(f"done in {time.monotonic() - start:.0f} s{where}")
    return 0


def parse_experiment(command: str, arguments: list[str]) -> Experiment | None:
    """The experiment that a YAML file and the command line's overrides describe; None if only help was asked for.

    Raises ConfigError if a file is missing, or a key or value does not fit.
    """
    from wheretolook.config import MOVED, Experiment

    options, short = all_options(Experiment), {**_SHORT, **STAGES[command].short}
    arguments = list(arguments)
    places = [place for place, name in enumerate(arguments) if name in _SIGNED and place + 1 < len(arguments)]
    for place in reversed(places):  # a value such as -y looks like an option
        arguments[place : place + 2] = [f"{arguments[place]}={arguments[place + 1]}"]
    given = [argument.partition("=") for argument in arguments]
    arguments = [short.get(name, name) + equals + value for name, equals, value in given]
    if {"-h", "--help", "--help-all"} & {*arguments}:
        print(_help(command, options, everything="--help-all" in arguments))
        return None
    names = [argument.partition("=")[0] for argument in arguments if argument.startswith("--")]
    names = [name.removeprefix("--").removesuffix("+") for name in names]
    known = {**options, **{name: Option(name, "") for name in ("config", "print_config", "help-all", "debug")}}
    known |= {flag.removeprefix("--"): Option(flag, "") for flag in short}
    check_names(names, known, MOVED, "--")
    if "config" not in names and STAGES[command].config:
        arguments = ["--config", str(shipped(f"configs/{STAGES[command].config}.yaml")), *arguments]
    arguments = [part for one in arguments for part in (one.split("=", 1) if one.startswith("--config=") else [one])]
    places = [number for number, flag in enumerate(arguments[:-1], 1) if flag == "--config"]
    for place in places:
        arguments[place] = str(or_shipped(arguments[place]))
        _check_file(Path(arguments[place]), options)
    for flag, value in _groups_given(arguments, options):
        if not value.lstrip().startswith("{"):  # settings themselves, written out
            _check_file(Path(value), options, f"{flag.removeprefix('--')}.")
    return _with_shipped_weights(_parsed(command, arguments, ", ".join(arguments[place] for place in places) or None))


def _with_shipped_weights(experiment: Experiment) -> Experiment:
    """The experiment with weights that are named as they lie in the project's folder found from any other."""
    found: dict[str, Any] = {"evaluate": tuple(map(or_shipped, experiment.evaluate.weights))}
    for name in ("adapt", "viewpoint_map", "plan", "paths"):
        weights = getattr(experiment, name).weights
        found[name] = weights and or_shipped(weights)
    return replace(experiment, **{name: replace(getattr(experiment, name), weights=w) for name, w in found.items()})


def _groups_given(arguments: list[str], options: Mapping[str, Option]) -> list[tuple[str, str]]:
    """The flags of whole groups of options, such as --map, each with its value: a file of the group's settings."""
    split = [one.split("=", 1) if one.startswith("--") else [one] for one in arguments]
    words = [part for parts in split for part in parts]
    groups = {f"--{name}" for name, option in options.items() if option.is_group}
    return [(flag, value) for flag, value in pairwise(words) if flag in groups]


def _check_file(path: Path, options: Mapping[str, Option], group: str = "") -> None:
    """Raise ConfigError, with the file's path, unless it can be read and every key in it is an option's, or a group's.

    A group's name ends on a dot.
    """
    from wheretolook.config import MOVED
    from wheretolook.utils.reading import read_yaml

    try:
        content = read_yaml(path) or {}
    except FileNotFoundError as error:
        near, there = nearest(str(path), shipped_configs()), ", ".join(shipped_configs())
        fix = f"Did you mean {near}?" if near else f"Give the path of a YAML file, or one that ships: {there}."
        raise ConfigError("there is no such file", path=path, fix=fix) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"this is no YAML: {error}", path=path) from error
    try:
        if not isinstance(content, dict):
            raise ConfigError("a file of settings is a mapping", fix="Write settings, such as `name: demo`.")
        check_names(names_in(content, options, group), options, MOVED)
    except ConfigError as error:
        raise ConfigError(error.problem, path=path, value=error.value, fix=error.fix) from error


@cache
def _parser(command: str) -> Any:
    """What parses the options of a stage. It takes a fifth of a second to make."""
    from jsonargparse import ArgumentParser

    from wheretolook.config import Experiment

    parser = ArgumentParser(prog=f"wheretolook {command}", exit_on_error=False, add_help=False, allow_abbrev=False)
    parser.add_argument("--config", action="config")
    parser.add_class_arguments(Experiment)
    return parser


def _parsed(command: str, arguments: list[str], file: str | None) -> Experiment:
    from jsonargparse import ArgumentError

    from wheretolook.config import Experiment

    parser = _parser(command)
    try:
        settings = vars(parser.instantiate(parser.parse_args(arguments)))
        settings.pop("config")
        return Experiment(**settings)
    except (ArgumentError, WhereToLookError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, WhereToLookError):
                explained = f"`wheretolook {command} --help-all` explains it."
                fix = cause.fix or f"Correct it there or on the command line; {explained}"
                path = cause.path or file
                raise type(cause)(cause.problem, path=path, value=cause.value, fix=fix) from error
            cause = cause.__cause__ or cause.__context__
        problem = " ".join(str(error).split())
        path = None if problem.startswith("unrecognized arguments") else file
        raise ConfigError(problem, path=path, fix=f"`wheretolook {command} --help-all` lists the options.") from error


def _help(command: str, options: Mapping[str, Option], everything: bool) -> str:
    """The options that matter to a stage, or all that it reads; a file may hold those of every other stage too."""
    stage = STAGES[command]
    parts = [f"usage: wheretolook {command} [--config FILE.yaml] [--GROUP.OPTION VALUE ...]", stage.text]
    if everything:
        roots = {group.partition(".")[0] for other in STAGES.values() for group in other.groups}
        read = []
        for name, option in options.items():
            within = any(f"{name}.".startswith(f"{group}.") for group in stage.groups)
            if within or not stage.groups or name.partition(".")[0] not in roots:
                read.append(option)
        parts.append(grouped(read))
    else:
        shown = {"--config": Option("config", "YAML file of options, such as configs/demo.yaml")}
        for name in f"{_COMMON} {stage.matter}".split():
            long = {**_SHORT, **stage.short}.get(f"--{name}", name).removeprefix("--")
            shown[f"--{name}"] = options[long]
        more = sum(not (option.is_group or option.is_fixed) for option in options.values())
        parts.append(short_lines(shown))
        parts.append(f"wheretolook {command} --help-all explains every option it reads, of {more} in all.")
    parts.append(f"Example:\n  wheretolook {command} {stage.example}")
    return "\n\n".join([*parts, *([stage.notes] if stage.notes else [])])


def _quieten() -> None:
    """Keep libraries' chatter out of the progress; --debug brings it back."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    os.environ.setdefault("PYTHONWARNINGS", "ignore")  # for worker processes
    warnings.simplefilter("ignore")
    for kind in (OutOfRangeWarning, MapWarning, LockWarning, TrackingWarning):  # the user's own things, not chatter
        warnings.simplefilter("default", kind)
    warnings.formatwarning = lambda message, *_, **__: f"wheretolook: warning: {message}\n"
    for name in ("lightning", "lightning.pytorch", "lightning.fabric", "mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.ERROR)


if __name__ == "__main__":
    sys.exit(main())
