"""The command line: `wheretolook COMMAND [--config FILE.yaml] [--OPTION VALUE ...]`."""

from __future__ import annotations

import atexit
import gc
import json
import os
import re
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_type_hints

from wheretolook.utils.errors import ConfigError, WhereToLookError, did_you_mean
from wheretolook.utils.files import MAX_PIXELS
from wheretolook.utils.package import EXTRAS, VERSION, missing_package, or_shipped, shipped, shipped_configs
from wheretolook.utils.processes import collect_less_garbage, in_main_thread, interrupt, on_sigterm
from wheretolook.utils.texts import quiet_libraries

COMMANDS = {
    "scenes": "wheretolook.commands.scenes:Scenes",
    "map": "wheretolook.commands.map:Map",
    "sample": "wheretolook.commands.sample:Sample",
    "label": "wheretolook.commands.label:Label",
    "train": "wheretolook.commands.train:Train",
    "evaluate": "wheretolook.commands.evaluate:Evaluate",
    "adapt": "wheretolook.commands.adapt:Adapt",
    "viewpoint-map": "wheretolook.commands.viewpoint_map:BuildViewpointMap",
    "plan": "wheretolook.commands.plan:Plan",
    "demo": "wheretolook.commands.demo:Demo",
    "select": "wheretolook.commands.select:Select",
    "score": "wheretolook.commands.select:Score",
    "localize": "wheretolook.commands.localize:Localize",
    "check": "wheretolook.commands.check:Check",
    "view": "wheretolook.commands.view:View",
    "export": "wheretolook.commands.export:Export",
}
"""Dataclass of each command's options, whose `run()` does the work. Packages add theirs as entry points of this group."""

GROUP = "wheretolook.commands"

NUMBERS = re.compile(r"tuple\[(int|float),")
NUMBER = re.compile(r"[^\s,()\[\]]+")
"""Types of several numbers, and each of these where they are written 1 2 3, 1,2,3 or [1, 2, 3]."""

NEEDED = {"bool": "true or false", "int": "a whole number", "float": "a number"}
"""Descriptions of types by their names."""

ENVIRONMENT = {
    "OMP_WAIT_POLICY": "PASSIVE",  # idle threads leave the core to other processes
    "OPENCV_IO_MAX_IMAGE_PIXELS": str(MAX_PIXELS),  # also of formats that Pillow does not read
    "GLOG_logtostderr": "1",  # COLMAP leaves no log files in the folder of temporary files
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns the exit code: 0, 2 for bad input, 130 when interrupted by Ctrl-C or SIGTERM, 141 when the reader of the
    output, such as `head`, has closed it.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    collect_less_garbage()
    atexit.register(gc.freeze)  # collections at the exit after `import torch` would take half a second
    given = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    debug = "--debug" in given
    if not debug:
        quiet_libraries()
    try:
        if in_main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, interrupt)
        run_command([argument for argument in given if argument != "--debug"])
        sys.stdout.flush()
        return 0
    except KeyboardInterrupt:
        print("\nwheretolook: interrupted; finished work is kept, run the same command to continue", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the flush at the exit fails
        return 141
    except (WhereToLookError, OSError) as error:
        if debug:
            traceback.print_exc()
        text = f"{error.filename or 'a file'}: {error.strerror or error}" if isinstance(error, OSError) else str(error)
        print(f"wheretolook: error: {text}", file=sys.stderr)
        return 2


def run_command(arguments: list[str]) -> None:
    """Run the command that the first argument names with the options that follow it."""
    name, *rest = arguments
    if name in ("-h", "--help", "help"):
        print_commands()
    elif name == "--version":
        print(f"wheretolook {VERSION}")
    elif {"-h", "--help"} & {*rest}:
        build_parser(name).print_help()
    else:
        start = time.monotonic()
        command = parse_command(name, rest)
        on_sigterm(interrupt)
        try:
            command.run()
        except ModuleNotFoundError as error:
            if error.name not in EXTRAS:
                raise
            raise missing_package(error.name) from error
        listed = getattr(command, command.LISTING, False)
        if hasattr(command, "root") and not listed and command.root.is_dir():
            print(f"done in {time.monotonic() - start:.0f} s: {command.root}")


@cache
def command_targets() -> dict[str, str]:
    """Return `module:Class` of every command by its name, those of installed packages included."""
    return COMMANDS | {entry.name: entry.value for entry in entry_points(group=GROUP)}


def load_command(name: str) -> Any:
    """Return the dataclass of a command. Raises ConfigError if there is none of this name."""
    targets = command_targets()
    if name not in targets:
        fix = did_you_mean(name, targets) or f"Use one of {', '.join(targets)}."
        raise ConfigError("unknown command", value=name, fix=fix)
    return resolve_name(targets[name])


def print_commands() -> None:
    """Print the name and the one-line summary of every command."""
    print(
        "wheretolook: choose camera views that localize\n\nusage: wheretolook COMMAND [--config FILE.yaml] [--OPTION VALUE ...] [--debug]\n"
    )
    for name in command_targets():
        print(f"  {name:<15}{load_command(name).__doc__.splitlines()[0]}")
    print("\n`wheretolook COMMAND --help` lists the options of a command, `wheretolook --version` prints the version.")


def build_parser(name: str) -> Any:
    """Return the jsonargparse parser of a command's options."""
    from argparse import RawDescriptionHelpFormatter

    from jsonargparse import ArgumentParser, DefaultHelpFormatter

    class HelpFormatter(RawDescriptionHelpFormatter, DefaultHelpFormatter):
        """Keeps the line breaks of a command's description."""

    command = load_command(name)
    option_types(command)
    about, _, _ = command.__doc__.partition("\n    Args:")
    short = ", ".join(f"--{short} for --{option}" for short, option in command.SHORT.items())
    parser = ArgumentParser(
        prog=f"wheretolook {name}",
        usage=f"wheretolook {name} [--config FILE.yaml] [--OPTION VALUE ...]",
        description=about.replace("\n    ", "\n"),
        epilog=f"Short forms: {short}." if short else None,
        formatter_class=HelpFormatter,
        exit_on_error=False,
    )
    parser.add_argument("--config", action="config", help="YAML file with a section for each group of options")
    parser.add_class_arguments(command)
    return parser


def parse_command(name: str, arguments: Sequence[str]) -> Any:
    """Return the command with the options that YAML files (`--config`) and then the arguments set.

    Raises ConfigError for an option that does not exist, or a value of the wrong kind or out of range.
    """
    from jsonargparse import ArgumentError

    command = load_command(name)
    types = option_types(command)
    given = list(named_values(command, types, arguments))
    files = [value for option, value in given if option == "config"]
    if not files and command.CONFIG:
        files = [str(shipped(f"configs/{command.CONFIG}.yaml"))]
    set_by_files = [setting for file in files for setting in read_settings(or_shipped(file), types)]
    options = [(option, value) for option, value in given if option != "config"]
    chosen: dict[str, str] = {}
    for option, value in options:
        if chosen.setdefault(option, value) != value:
            raise ConfigError(f"--{option} has two values", value=(chosen[option], value), fix="Give it once.")
    settings = [*set_by_files, *options]
    parser = build_parser(name)
    try:
        parsed = vars(parser.instantiate(parser.parse_args([f"--{option}={value}" for option, value in settings])))
        parsed.pop("config")
        return command(**parsed)
    except (ArgumentError, WhereToLookError) as error:
        raise explained(error, name, ", ".join(files) or None, types, {option for option, _ in given}) from error


def explained(
    error: BaseException, name: str, files: str | None, types: Mapping[str, Any], given: set[str]
) -> WhereToLookError:
    """Return the error of this project that the parser's error hides, or a ConfigError on the option that it names.

    It names the files, unless the option is among those given as arguments.
    """
    help_text = f"`wheretolook {name} --help` explains the options."
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, WhereToLookError):
            return type(cause)(cause.problem, path=cause.path or files, value=cause.value, fix=cause.fix or help_text)
        cause = cause.__cause__ or cause.__context__
    text = " ".join(str(error).split())
    if missing := re.search("arguments are required: (.*)", text):
        return ConfigError(f"--{missing[1].replace(', ', ' and --')} must be given", path=files, fix=help_text)
    if wrong := re.search(r'Parser key "([\w.]+)".*(?:Got value|Given value): (.*)', text):
        option, value = wrong.groups()
        short = next((short for short, known in load_command(name).SHORT.items() if known == option), option)
        if needed := describe_type(str(types.get(option))):
            return ConfigError(
                f"--{short} needs {needed}", path=None if option in given else files, value=value, fix=help_text
            )
    return ConfigError(text, path=files, fix=help_text)


def describe_type(kind: str) -> str:
    """Describe the values that an option's type, as text, allows; empty for types without a short description."""
    if kind.startswith("typing.Literal"):
        return "one of " + ", ".join(re.findall("'(.*?)'", kind))
    if NUMBERS.match(kind):
        return "numbers" if "..." in kind else f"{kind.count(',') + 1} numbers"
    return next((text for name, text in NEEDED.items() if name in kind), "")


def option_types(command: Any, prefix: str = "") -> dict[str, Any]:
    """Return the types of all options of a dataclass of dataclasses by dotted name."""
    types: dict[str, Any] = {}
    hints = get_type_hints(command)
    command.__init__.__annotations__.update(hints)  # or the parser would import modules that only type checkers need
    for field in fields(command):
        kind = hints[field.name]
        if field.init and is_dataclass(kind):
            types |= option_types(kind, f"{prefix}{field.name}.")
        elif field.init:
            types[f"{prefix}{field.name}"] = kind
    return types


def named_values(command: Any, types: Mapping[str, Any], arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield full name and value of each option in the arguments; several values become a list, none becomes true.

    Values before the first option are those of the command's option `POSITIONAL`.
    """
    words: list[list[str]] = [[f"--{command.POSITIONAL}"]]
    for argument in arguments:
        if argument.startswith("--"):
            words.append(argument.split("=", 1))
        else:
            words[-1].append(argument)
    if len(words[0]) == 1:
        words = words[1:]
    known = [*types, "config", "print_config"]
    for option, *values in words:
        name = option.removeprefix("--").replace("-", "_")
        name = command.SHORT.get(name.replace("_", "-"), name)
        if not is_option(name, known):
            if hasattr(command, "root") and "." in name and is_option(name, configurable_options()):
                continue  # of a group of another command: the same options may be given to all
            fix = did_you_mean(name, [*known, *command.SHORT], "--")
            raise ConfigError("unknown option", value=option, fix=fix)
        kind = str(types.get(name))
        text = " ".join(values)
        if NUMBERS.match(kind) and text != "null":
            values = [f"[{', '.join(NUMBER.findall(text))}]"]
        elif kind.startswith("tuple[") and not text.startswith(("[", "null")):
            values = [json.dumps(values)]
        if len(values) > 1:
            raise ConfigError("this option takes one value", value=f"{option} {text}")
        elif not values and kind != str(bool) and name != "print_config":
            raise ConfigError("this option needs a value", value=option)
        else:
            yield name, values[0] if values else "" if name == "print_config" else "true"


def is_option(name: str, known: Sequence[str]) -> bool:
    """Return whether a dotted name is an option's, or that of a key within the value of an option of a group."""
    return any(name == option or ("." in option and name.startswith(f"{option}.")) for option in known)


def read_settings(path: Path, types: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Read the options of one command from a YAML file that may hold those of all commands.

    Raises ConfigError, naming the file, if it cannot be read or sets an option that no command has.
    """
    from wheretolook.utils.files import read_yaml

    try:
        content = read_yaml(path) or {}
    except FileNotFoundError as error:
        known = shipped_configs()
        fix = did_you_mean("/".join(path.parts[-2:]), known) or f"Bundled configurations: {', '.join(known)}."
        raise ConfigError("there is no such file", path=path, fix=fix) from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"not a YAML file: {error}", path=path) from error
    if not isinstance(content, dict):
        raise ConfigError("a configuration is a mapping", path=path, fix="Write settings, such as `name: demo`.")
    settings = []
    for name, value in flattened(content, types):
        if is_option(name, list(types)):
            settings.append((name, value if isinstance(value, str) else json.dumps(value, default=str)))
        elif not is_option(name, known := configurable_options()):
            raise ConfigError("unknown option", path=path, value=name, fix=did_you_mean(name, known))
    return settings


def flattened(content: Mapping[str, Any], types: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of nested mappings, down to the options."""
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict) and value and not ("." in name and name in types):
            yield from flattened(value, types, f"{name}.")
        else:
            yield name, value


@cache
def configurable_options() -> list[str]:
    """Return the dotted names of the options of all commands that read configurations: those that have a dataset."""
    commands = [command for command in map(load_command, command_targets()) if hasattr(command, "root")]
    return [option for command in commands for option in option_types(command)]


if __name__ == "__main__":
    sys.exit(main())
