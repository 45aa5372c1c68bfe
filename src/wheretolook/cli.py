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
from dataclasses import replace
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from wheretolook.commands import OWN, STAGES, USAGE
from wheretolook.utils.errors import (
    ConfigError,
    LockWarning,
    MapWarning,
    OutOfRangeWarning,
    TrackingWarning,
    WhereToLookError,
)
from wheretolook.utils.images import MAX_PIXELS
from wheretolook.utils.options import Option, all_options, check_names, grouped, names_in, nearest, short_lines
from wheretolook.utils.shipped import or_shipped, shipped, shipped_configs
from wheretolook.utils.version import VERSION

if TYPE_CHECKING:
    from wheretolook.config import Experiment


_SHORT = {"--engine": "--label.engine", "--images": "--map.photographs.images"}  # flags of every stage
_SIGNED = ("--up", "--scenes.rgbd.up", "--map.existing.mesh_up")  # flags whose value may begin with a minus sign
_COMMON = "name data device"  # the options that matter to every stage


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Returns the exit code: 0, 2 for bad input, 130 when interrupted."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads leave the core to other processes
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # also of images that Pillow does not know
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
            threading.Thread(target=send_again, daemon=True).start()
        else:
            usual(lost)

    def send_again() -> None:
        main_thread = threading.main_thread().ident or 0
        while not ended.wait(0.005):
            frame = sys._current_frames().get(main_thread)
            while frame is not None and frame.f_code is not interrupt_again.__code__:
                frame = frame.f_back
            if frame is None:  # within that function it would be dropped once more
                signal.pthread_kill(main_thread, signal.SIGINT)  # a real signal, which also ends what waits
                return

    ended = threading.Event()
    usual, sys.unraisablehook = sys.unraisablehook, interrupt_again
    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = usual
        ended.set()


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
        from wheretolook.scorers.registry import describe_methods

        texts = describe_methods()
        width = max(map(len, texts))
        print("\n".join(f"{name:<{width}}  {text}" for name, text in texts.items()))
        return 0
    if command == "figures" and "--list" in arguments:
        from wheretolook_paper.release.catalog import catalog_text

        print(catalog_text())
        return 0
    experiment = parse_experiment(command, arguments)
    if experiment is None:
        return 0
    if experiment.device != "auto":
        _ = experiment.warp_device  # refused now if it is not there, not after hours of other work
    if STAGES[command].refuses:
        import_module(STAGES[command].refuses).check(experiment)
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

    options = all_options(Experiment)
    short = {**_SHORT, **STAGES[command].short}
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
        near = nearest(str(path), shipped_configs())
        there = ", ".join(shipped_configs())
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
