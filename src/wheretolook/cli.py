"""The command line: `wheretolook COMMAND [--config FILE.yaml] [--OPTION VALUE ...]`."""

from __future__ import annotations

import atexit
import gc
import inspect
import os
import re
import signal
import sys
import time
import traceback
from argparse import RawDescriptionHelpFormatter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_args, get_type_hints

from jsonargparse import ArgumentError, ArgumentParser, DefaultHelpFormatter

from wheretolook.utils.errors import ConfigError, WhereToLookError, did_you_mean
from wheretolook.utils.files import MAX_PIXELS, read_yaml
from wheretolook.utils.package import EXTRAS, VERSION, missing_package, or_shipped, shipped, shipped_configs
from wheretolook.utils.processes import collect_less_garbage, in_main_thread, interrupt, on_sigterm
from wheretolook.utils.texts import quiet_libraries

COMMANDS = {
    "scenes": "wheretolook.commands.scenes:Scenes",
    "map": "wheretolook.commands.map:BuildMap",
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
    "audit": "wheretolook.commands.audit:AuditMap",
    "extend": "wheretolook.commands.extend:Extend",
    "view": "wheretolook.commands.view:View",
    "export": "wheretolook.commands.export:Export",
}
"""Dataclass of each command's options, whose `run()` does the work. Packages add theirs as entry points of this group."""

NUMBERS = re.compile(r"tuple\[(int|float),")
"""Types of several numbers."""


def _freeze() -> None:
    """Omit collections at the exit, which after `import torch` take half a second; without them OMPL reports leaks."""
    if "ompl" not in sys.modules:
        gc.freeze()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns the exit code: 0, 2 for bad input, 130 when interrupted by Ctrl-C or SIGTERM, 141 when the reader of the
    output, such as `head`, has closed it.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads leave the core to other processes
    # also of formats that Pillow does not read
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))
    os.environ.setdefault("GLOG_logtostderr", "1")  # COLMAP leaves no log files in the folder of temporary files
    collect_less_garbage()
    atexit.register(_freeze)
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
    return COMMANDS | {entry.name: entry.value for entry in entry_points(group="wheretolook.commands")}


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


@dataclass(frozen=True)
class Option:
    """An option of a command: a field of its dataclass, or of a dataclass within it.

    Attributes:
        kind: its type.
        about: its description.
        default: its value if it is not given; MISSING if it must be given.
        group: description of its group; empty for the command's own.
    """

    kind: Any
    about: str
    default: Any
    group: str


def command_options(command: Any) -> dict[str, Option]:
    """Return the options of a command's dataclass by their names, dotted in groups."""
    return dict(_options(command, MISSING, "", "", command.GROUPS))


def _options(
    kind: Any, defaults: Any, prefix: str, group: str, prefixes: Mapping[str, str]
) -> Iterator[tuple[str, Option]]:
    """Yield the options of a dataclass, with the values of an instance as defaults; MISSING for those of its fields."""
    hints = get_type_hints(kind)
    about = described_fields(kind)
    for field in option_fields(kind):
        name = field.name
        default = default_of(field) if defaults is MISSING else getattr(defaults, name)
        if is_dataclass(hints[name]):
            inner = prefixes.get(name, f"{prefix}{name}.")
            yield from _options(hints[name], default, inner, about.get(name, name) if inner else group, {})
        else:
            yield f"{prefix}{name}", Option(hints[name], about.get(name, ""), default, group)


def construct(
    kind: Any, values: Mapping[str, Any], prefix: str = "", prefixes: Mapping[str, str] = {}, defaults: Any = MISSING
) -> Any:
    """Return a dataclass with the values of its options by their names. Raises what its checks do."""
    hints = get_type_hints(kind)
    given = {}
    for field in option_fields(kind):
        name = field.name
        if is_dataclass(hints[name]):
            default = default_of(field) if defaults is MISSING else getattr(defaults, name)
            given[name] = construct(hints[name], values, prefixes.get(name, f"{prefix}{name}."), {}, default)
        else:
            given[name] = values[f"{prefix}{name}"]
    return kind(**given) if defaults is MISSING else replace(defaults, **given)


def option_fields(kind: Any) -> list[Field[Any]]:
    """Return the fields of a dataclass that the command line sets."""
    return [field for field in fields(kind) if field.init and field.metadata.get("option", True)]


def default_of(field: Field[Any]) -> Any:
    """Return the default of a field; MISSING if it has none."""
    return field.default if field.default_factory is MISSING else field.default_factory()


def described_fields(kind: Any) -> dict[str, str]:
    """Return descriptions of fields: the section `Args` in the docstrings of a dataclass and its bases."""
    about: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        _, _, section = inspect.cleandoc(base.__doc__ or "").partition("\nArgs:\n")
        for name, text in re.findall(r"^    (\w+): (.*(?:\n        .*)*)", section, re.MULTILINE):
            about[name] = " ".join(text.split())
    return about


def build_parser(name: str) -> Any:
    """Return the jsonargparse parser of a command's options."""

    class HelpFormatter(RawDescriptionHelpFormatter, DefaultHelpFormatter):
        """Keeps the line breaks of a command's description."""

    command = load_command(name)
    about, _, _ = command.__doc__.partition("\n    Args:")
    short = ", ".join(f"--{short} for --{option}" for short, option in command.SHORT.items() if "." not in short)
    parser = ArgumentParser(
        prog=f"wheretolook {name}",
        usage=f"wheretolook {name} [--config FILE.yaml] [--OPTION VALUE ...]",
        description=about.replace("\n    ", "\n"),
        epilog=f"Short forms: {short}." if short else None,
        formatter_class=HelpFormatter,
        exit_on_error=False,
    )
    parser.add_argument("--config", help="YAML file with a section for each group of options")
    parser.add_argument("--print_config", type=bool, default=False, help="only print all options as YAML")
    groups: dict[str, Any] = {"": parser}
    for option, known in command_options(command).items():
        if known.group not in groups:
            groups[known.group] = parser.add_argument_group(known.group.rstrip("."))
        needed = {"required": True} if known.default is MISSING else {"default": known.default}
        groups[known.group].add_argument(f"--{option}", type=known.kind, help=known.about, **needed)
    return parser


def parse_command(name: str, arguments: Sequence[str]) -> Any:
    """Return the command with the options that YAML files (`--config`) and then the arguments set.

    Raises ConfigError for an option that does not exist, or a value of the wrong kind or out of range.
    """
    command = load_command(name)
    options = {known: option.kind for known, option in command_options(command).items()}
    given, files = read_arguments(command, options, arguments)
    if not files and command.CONFIG:
        files = [str(shipped(f"configs/{command.CONFIG}.yaml"))]
    values: dict[str, Any] = {}
    for settings in (*(read_settings(or_shipped(file), command, options) for file in files), given):
        for option, value in settings.items():
            if value is None and type(None) not in (options[option], *get_args(options[option])):
                raise ConfigError("this option needs a value", path=", ".join(files), value=option)
            former = values.get(option)
            values[option] = {**former, **value} if isinstance(former, dict) and isinstance(value, dict) else value
    parser = build_parser(name)
    try:
        parsed = parser.parse_object(values)
        made = construct(command, parser.instantiate(parsed), prefixes=command.GROUPS)
    except (ArgumentError, WhereToLookError) as error:
        raise explained(error, name, ", ".join(files) or None, options, {*given}) from error
    if parsed.pop("print_config"):
        parsed.pop("config")
        print(parser.dump(parsed), end="")
        sys.exit()
    return made


def explained(
    error: BaseException, name: str, files: str | None, options: Mapping[str, Any], given: set[str]
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
        if needed := describe_type(str(options.get(option))):
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
    needed = {"bool": "true or false", "int": "a whole number", "float": "a number"}
    named = re.findall("'(.*?)'", kind) if "Literal[" in kind else []
    return ", or ".join([*(text for name, text in needed.items() if name in kind)][:1] + named)


def full_name(command: Any, name: str) -> str:
    """Return the name of an option that is given by its short name, or with the group that the command leaves out."""
    short = {known.replace("-", "_"): option for known, option in command.SHORT.items()}
    if name in short:
        return str(short[name])
    for group, prefix in command.GROUPS.items():
        if name.startswith(f"{group}."):
            name = prefix + name.removeprefix(f"{group}.")
    return str(short.get(name, name))


def option_of(name: str, known: Iterable[str]) -> str | None:
    """Return the option of this name, or the option of a group that has it as a key of its value; None if there is none."""
    return next(
        (option for option in known if name == option or ("." in option and name.startswith(f"{option}."))), None
    )


def with_keys(name: str, option: str, value: Any) -> Any:
    """Return the value of an option of which a dotted name sets one key."""
    for key in reversed(name.removeprefix(option).split(".")[1:]):
        value = {key: value}
    return value


def read_arguments(
    command: Any, options: Mapping[str, Any], arguments: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    """Return the values of options by their full names, as texts, lists of them or true; and the files of `--config`.

    Values before the first option are those of the command's option `POSITIONAL`. Raises ConfigError for an option that
    does not exist, has no value, or two.
    """
    words: list[list[str]] = [[f"--{command.POSITIONAL}"]]
    for argument in arguments:
        if argument.startswith("--"):
            words.append(argument.split("=", 1))
        else:
            words[-1].append(argument)
    if len(words[0]) == 1:
        words = words[1:]
    known = [*options, "config", "print_config"]
    given: dict[str, Any] = {}
    files: list[str] = []
    for option, *texts in words:
        name = full_name(command, option.removeprefix("--").replace("-", "_"))
        found = option_of(name, known)
        if found is None:
            if hasattr(command, "root") and "." in name and option_of(name, configurable_options()):
                continue  # of a group of another command: the same options may be given to all
            meant = {"top": "n", "num": "n", "k": "n"}.get(name, name)  # of the best views
            fix = did_you_mean(meant if meant in known else name, [*known, *command.SHORT], "--")
            raise ConfigError("unknown option", value=option, fix=fix)
        value = with_keys(name, found, read_value(option, str(options.get(found)), texts, found == "print_config"))
        if found == "config":
            files.append(value)
            continue
        former = given.get(found)
        if isinstance(former, dict) and isinstance(value, dict):
            value = {**former, **value}
        elif found in given and former != value:
            raise ConfigError(f"--{found} has two values", value=(former, value), fix="Give it once.")
        given[found] = value
    return given, files


def read_value(option: str, kind: str, texts: list[str], is_flag: bool) -> Any:
    """Return the value that words after an option of a type mean: a text, a list of texts, or true for none.

    Raises ConfigError if the type takes one value and there are more, or none.
    """
    if not texts:
        if is_flag or kind == str(bool):
            return True
        raise ConfigError("this option needs a value", value=option)
    joined = " ".join(texts)
    if NUMBERS.match(kind) and joined != "null":  # written 1 2 3, 1,2,3 or [1, 2, 3]
        return re.findall(r"[^\s,()\[\]]+", joined)
    if kind.startswith("tuple[") and not joined.startswith(("[", "null")):
        return texts
    if len(texts) > 1:
        raise ConfigError("this option takes one value", value=f"{option} {joined}")
    return texts[0]


def read_settings(path: Path, command: Any, options: Mapping[str, Any]) -> dict[str, Any]:
    """Read the options of one command from a YAML file that may hold those of all commands.

    Raises ConfigError, naming the file, if it cannot be read or sets an option that no command has.
    """
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
    settings: dict[str, Any] = {}
    for name, value in flattened(content, command, options):
        if found := option_of(name, options):
            settings[found] = str(value) if options[found] is str else with_keys(name, found, value)
        elif not option_of(name, configurable_options()):
            raise ConfigError("unknown option", path=path, value=name, fix=did_you_mean(name, configurable_options()))
    return settings


def flattened(
    content: Mapping[str, Any], command: Any, options: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield full names and values of nested mappings, down to the options."""
    for key, value in content.items():
        name = f"{prefix}{key}"
        full = full_name(command, name)
        if isinstance(value, dict) and value and not ("." in full and full in options):
            yield from flattened(value, command, options, f"{name}.")
        else:
            yield full, value


@cache
def configurable_options() -> list[str]:
    """Return the names of the options of all commands that read configurations: those that have a dataset.

    Options of groups that a command leaves out have both names.
    """
    names = []
    for command in map(load_command, command_targets()):
        if hasattr(command, "root"):
            options = [*command_options(command)]
            groups = [f"{group}.{name}" for group, prefix in command.GROUPS.items() for name in options if not prefix]
            names += [*options, *groups, *(short for short in command.SHORT if "." in short)]
    return names


if __name__ == "__main__":
    sys.exit(main())
