"""The command line: `wheretolook STAGE --config configs/demo.yaml`, one sub-command for each stage."""

from __future__ import annotations

import logging
import os
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.utils.errors import ConfigError, WhereToLookError
from wheretolook.utils.version import VERSION

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser

    from wheretolook.config import Experiment

STAGES = {
    "scenes": ("make_scenes", "Make or load the textured meshes.", ("scenes",)),
    "map": (
        "make_maps",
        "Build a COLMAP map of every scene from renders along a walk, or of a folder of photographs: --images FOLDER.",
        ("map", "scenes.free_space", "label.workers"),
    ),
    "sample": (
        "sample",
        "Choose viewpoints by the landmarks they see.",
        (
            "sample",
            "occlusion",
            "scenes.free_space",
            "scenes.mapped_space",
            "map.photographs.assume_metric",
        ),
    ),
    "label": ("label", "Render and localize every viewpoint, measure the pose error. Resumes.", ("label", "tracking")),
    "train": ("train", "Learn from the labels, one weights file for each method.", ("train", "tracking")),
    "evaluate": ("evaluate", "Score all methods on the test scenes.", ("evaluate", "occlusion", "tracking")),
    "viewpoint-map": (
        "viewpoint_map",
        "Score every direction at every free voxel of a scene, for planners to look up. Needs no labels.",
        ("viewpoint_map", "occlusion", "scenes.free_space", "scenes.mapped_space", "map.photographs.assume_metric"),
    ),
    "plan": (
        "plan",
        "Plan a path on which the camera sees what it needs to know where it is; a table, a picture and a film of it.",
        ("plan", "occlusion", "scenes.free_space", "scenes.mapped_space", "map.photographs.assume_metric", "tracking"),
    ),
    "compare-paths": (
        "compare_paths",
        "Plan paths between random places by several methods, render what the camera sees, localize it. Resumes.",
        ("paths", "occlusion", "scenes.free_space", "label", "tracking"),
    ),
    "release": (
        "release",
        "Make a compact copy, data/release; given that copy and weights trained on it, evaluate and write its card.",
        ("evaluate", "occlusion", "tracking"),
    ),
    "log-release": (
        "log_release",
        "Log what a release ships as MLflow runs, as if it had been made here; once.",
        ("tracking",),
    ),
    "figures": (
        "figures",
        "Draw every figure and table of the paper, and others, from logged runs.",
        ("figures", "tracking"),
    ),
}
"""Sub-command: function in `wheretolook.stages`, what it does, groups of settings it reads."""

DEMO = "Run all stages on the embedded default and draw the score figure."

USAGE = """\
wheretolook: where to point a camera so that it knows where it is

usage: wheretolook STAGE [--config FILE.yaml] [--GROUP.SETTING VALUE ...] [--debug]

stages, in order; each reads what the one before it left in <data>/<name>/
{stages}

  wheretolook STAGE --help         the settings a stage reads, with their defaults
  wheretolook demo                 is configs/demo.yaml unless --config names another
  wheretolook map --config configs/demo.yaml --map.n_images 120
  wheretolook map --name photos --images FOLDER       a scene known from photographs alone
  wheretolook label --config configs/paper.yaml --engine ray     on a Ray cluster; the default is local
  wheretolook evaluate --list-methods    what can be compared
  wheretolook viewpoint-map --config configs/demo.yaml --scene apartment-000 --out room.map
  wheretolook figures --list             figures and tables of the paper; `wheretolook figures` draws them
  wheretolook --version
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Returns the exit code: 0, 2 for bad input, 130 when interrupted."""
    os.environ.setdefault(
        "OMP_WAIT_POLICY", "PASSIVE"
    )  # idle threads must not spin while other processes want the core
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0
    if arguments[0] == "--version":
        print(f"wheretolook {VERSION}")
        return 0
    if not debug:
        _quieten()
    try:
        return _run(arguments[0], arguments[1:])
    except WhereToLookError as error:
        if debug:
            traceback.print_exc()
        print(f"wheretolook: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if debug:
            traceback.print_exc()
        print(f"wheretolook: error: {error.filename or 'a file'}: {error.strerror or error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nwheretolook: interrupted; what is finished is kept, run the same command to go on", file=sys.stderr)
        return 130


def _usage() -> str:
    rows = [*((name, entry[1]) for name, entry in STAGES.items()), ("demo", DEMO)]
    return USAGE.format(stages="\n".join(f"  {name:<15}{text}" for name, text in rows))


def _method_list() -> str:
    """Every method that `evaluate.methods` may name, with what it is."""
    from wheretolook.methods.registry import describe_methods

    texts = describe_methods()
    width = max(map(len, texts))
    return "\n".join(f"{name:<{width}}  {text}" for name, text in texts.items())


def _run(command: str, arguments: list[str]) -> int:
    if command not in (*STAGES, "demo"):
        raise ConfigError("unknown stage", value=command, fix=f"Use one of {', '.join((*STAGES, 'demo'))}.")
    if command == "evaluate" and "--list-methods" in arguments:
        print(_method_list())
        return 0
    if command == "figures" and "--list" in arguments:
        from wheretolook.release.catalog import catalog_text

        print(catalog_text())
        return 0
    experiment = parse_experiment(command, arguments)
    if experiment is None:
        return 0
    from wheretolook import stages

    if command == "demo":
        from wheretolook.stages.demo import run_demo

        run_demo(experiment)
    else:
        start = time.monotonic()
        name = STAGES[command][0]
        getattr(stages, name)(experiment)
        print(f"done in {time.monotonic() - start:.0f} s: {experiment.root}")
    return 0


def parse_experiment(command: str, arguments: list[str]) -> Experiment | None:
    """The experiment that a YAML file and the command line's overrides describe; None if only help was asked for.

    Raises:
        ConfigError: a file is missing, or a key or value does not fit.
    """
    from wheretolook.config import Experiment

    short = {**_SHORT, **_SHORT_OF.get(command, {})}
    arguments = [short.get(name, name) + equals + value for name, equals, value in
                 (argument.partition("=") for argument in arguments)]  # fmt: skip
    chosen = any(argument.startswith("--config") for argument in arguments)
    if command in _DEFAULT_CONFIG and not chosen and not {"-h", "--help"} & {*arguments}:
        arguments = ["--config", str(_default_config(command)), *arguments]
    parser = _parser(command)
    if "-h" in arguments or "--help" in arguments:
        print(_help(parser, command))
        return None
    from jsonargparse import ArgumentError

    files = [value for flag, value in pairwise(arguments) if flag == "--config"]
    files += [argument.removeprefix("--config=") for argument in arguments if argument.startswith("--config=")]
    file = ", ".join(files) or None
    for name in files:
        _check_groups(Path(name))
    try:
        settings = vars(parser.instantiate(parser.parse_args(arguments)))
        settings.pop("config")
        return Experiment(**settings)
    except (ArgumentError, WhereToLookError) as error:
        for cause in _causes(error):
            if isinstance(cause, WhereToLookError):
                fix = (
                    cause.fix or f"Correct it there or on the command line; `wheretolook {command} --help` explains it."
                )
                path = cause.path or file
                raise type(cause)(cause.problem, path=path, value=cause.value, fix=fix) from error
        problem = " ".join(str(error).split())
        path = None if problem.startswith("unrecognized arguments") else file
        raise ConfigError(problem, path=path, fix=f"`wheretolook {command} --help` lists the settings.") from error


def _check_groups(path: Path) -> None:
    """A group of settings that is no mapping would be passed over in silence, and the defaults used."""
    import yaml

    from wheretolook.config import Experiment

    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return  # the parser says what is wrong
    for name, default in vars(Experiment()).items():
        if is_dataclass(default) and isinstance(content, dict) and not isinstance(content.get(name, {}), dict):
            fix = f"Write its settings as `{name}: {{setting: value}}`."
            raise ConfigError(f"{name} is a group of settings", path=path, value=content[name], fix=fix)


def _parser(command: str) -> ArgumentParser:
    from jsonargparse import ArgumentParser

    from wheretolook.config import Experiment

    text = DEMO if command == "demo" else STAGES[command][1]
    parser = ArgumentParser(
        prog=f"wheretolook {command}",
        usage=f"wheretolook {command} [--config FILE.yaml] [--GROUP.SETTING VALUE ...]",
        description=text,
        exit_on_error=False,
    )
    parser.add_argument("--config", action="config", help="YAML file of an experiment, such as configs/demo.yaml")
    parser.add_class_arguments(Experiment)
    return parser


def _help(parser: ArgumentParser, command: str) -> str:
    """The settings this stage reads; the file may hold those of every other stage too."""
    groups = STAGES[command][2] if command in STAGES else ()

    def belongs(dest: str) -> bool:
        if not groups or ("." not in dest and dest not in _GROUPS):
            return True
        return any(dest == group or dest.startswith(f"{group}.") for group in (*groups, "camera"))

    for group in parser._action_groups:
        group._group_actions = [action for action in group._group_actions if belongs(action.dest)]
    return str(parser.format_help()) + _MORE_HELP.get(command, "")


_SHORT = {"--engine": "--label.engine", "--images": "--map.photographs.images"}
"""Flags that may be given without their group."""

_SHORT_OF = {
    "viewpoint-map": {f"--{name}": f"--viewpoint_map.{name}" for name in ("scene", "method", "weights", "out")},
    "figures": {f"--{name}": f"--figures.{name}" for name in ("out", "only", "kinds")},
    "plan": {f"--{name}": f"--plan.{name}" for name in ("scene", "start", "goal", "method", "weights", "out", "film")},
}
"""The same, of one sub-command alone, since others have flags of such names in their own groups."""

_DEFAULT_CONFIG = {"demo": "demo", "log-release": "release", "figures": "release"}
"""Sub-commands that need no --config: names of files in configs/."""

_MORE_HELP = {
    "evaluate": "\nWhat evaluate.methods may name: wheretolook evaluate --list-methods\n",
    "log-release": """
A release ships its tables, not an MLflow store. This logs them into one, in seconds: an evaluation with a nested run
for each method x N x occlusion x candidates, a train run for each weights record, the comparison of learners,
planned paths and measured times. Done again, it adds only what is new; `make ui` does it first. Without --config it is
configs/release.yaml.

  wheretolook log-release                               into mlruns/
  wheretolook log-release --tracking.folder elsewhere
""",
    "figures": """
Each file says which runs it was drawn from, and is attached to them as an artifact under figures/. Where a run is
missing, the command that makes it is named and the others are drawn; if one of the paper's, or one of those named with
--only, is missing, the exit code is 2. --out, --only and --kinds stand for the settings of figures. Without --config it
is configs/release.yaml, whose runs are logged first.

  wheretolook figures --list                            what there is, of the paper and beyond
  wheretolook figures --out figures                     everything, as PNG and PDF, tables as CSV, Markdown and TeX
  wheretolook figures --only '[top_n, runtimes]' --kinds '[svg]'
  wheretolook figures --config configs/demo.yaml        from the runs of the demo
""",
    "viewpoint-map": """
Reads a scene's map and its mesh, as the scenes and map stages leave them; a scene of photographs has no mesh, and is
free where scenes.mapped_space says. --scene, --method, --weights and --out stand for the settings of viewpoint_map.
Without weights or a method, the best weights of the dataset, or else those that ship, score the views. For example,
with the paper's network:

  wheretolook viewpoint-map --config configs/demo.yaml --scene apartment-000 \\
      --weights data/release/weights/mlp-2d+z.safetensors --out apartment.map

The folder holds plain arrays and LAYOUT.txt, which says how C++ or any language reads them. In Python:

  from wheretolook.planning import ViewpointMap
  viewpoint_map = ViewpointMap.load("apartment.map", mmap=True)
  choice = viewpoint_map.best((1.0, 2.0, 1.5))    # None where no camera can be, else axis, score, n_visible
""",
    "plan": """
Reads a scene's map and its mesh, if it has one, as the scenes and map stages leave them. --scene, --start, --goal,
--method, --weights, --out and --film stand for the settings of plan. For example, beside the shortest path:

  wheretolook plan --config configs/demo.yaml --scene apartment-000 --start '[-4, -3, 1.4]' --goal '[4, 3, 1.4]' \\
      --plan.against '[forward]' --film mp4 --out way

Without a mesh to keep clear of, by what depth images saw: --occlusion.model tsdf
""",
}

_GROUPS = {group.partition(".")[0] for _, _, groups in STAGES.values() for group in groups}


def _causes(error: BaseException) -> Iterator[BaseException]:
    cause: BaseException | None = error
    while cause is not None:
        yield cause
        cause = cause.__cause__ or cause.__context__


def _default_config(command: str) -> Path:
    path = Path(f"configs/{_DEFAULT_CONFIG[command]}.yaml")
    if not path.is_file():
        raise ConfigError(
            "the default configuration is not here", path=path, fix="Run in the project's folder, or give --config."
        )
    return path


def _quieten() -> None:
    """Keep libraries' chatter out of the progress; --debug brings it back."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    os.environ.setdefault("PYTHONWARNINGS", "ignore")  # for worker processes
    warnings.simplefilter("ignore")
    for name in ("lightning", "lightning.pytorch", "lightning.fabric", "mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.ERROR)


if __name__ == "__main__":
    sys.exit(main())
