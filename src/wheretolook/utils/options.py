"""Options as nested dataclasses declare them: their names, defaults and texts, and which one a wrong name meant.

Read from the classes alone, without making an instance of them and without the library that parses them, so that help
and a mistyped name are answered at once.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import inspect
import re
import shutil
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

WIDTH = 118  # columns of help, where the terminal has so many

_NAME_WIDTH = 36

T = TypeVar("T", bound="DataclassInstance")


class CommandParser(argparse.ArgumentParser):
    """Options of a command that is no stage: help as it is written, no abbreviations, errors that are ConfigErrors."""

    def __init__(self, prog: str, **about: Any) -> None:
        super().__init__(prog, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **about)

    def error(self, message: str) -> NoReturn:
        """Raise a ConfigError that names the command's help."""
        raise ConfigError(message, fix=f"`{self.prog} --help` lists the options.")


@dataclass(frozen=True)
class Option:
    """One option, or a group of them.

    A fixed one is a constant, a field that `__init__` does not take. It stands among the options because the record of
    a result must name it, but nobody needs to change it.
    """

    name: str  # with those of the groups it is in: "sample.grid"
    text: str  # what its class's docstring says of it
    default: str = ""  # as the command line takes it; empty for a group, and for a default that is worked out
    is_group: bool = False
    is_fixed: bool = False
    may_be_none: bool = False


def all_options(settings: type, prefix: str = "") -> dict[str, Option]:
    """All options of a dataclass of dataclasses by name, groups before what is in them."""
    texts = _texts(settings)
    found = {}
    for field in dataclasses.fields(settings):
        name = f"{prefix}{field.name}"
        text = texts.get(field.name, "")
        group = field.default_factory if field.default_factory is not MISSING else type(field.default)
        if isinstance(group, type) and dataclasses.is_dataclass(group):
            found[name] = Option(name, text, is_group=True)
            found |= all_options(group, f"{name}.")
        else:
            default = "" if field.default is MISSING else _shown(field.default)
            kind = field.type if isinstance(field.type, str) else repr(field.type)
            found[name] = Option(name, text, default, is_fixed=not field.init, may_be_none="None" in kind)
    return found


def recorded(settings: type[T], values: Mapping[str, Any]) -> T:
    """Settings as `dataclasses.asdict` recorded them with a result.

    Raises ConfigError if the record has another value of what is a constant.
    """
    fixed = {field.name for field in dataclasses.fields(settings) if not field.init}
    for name in fixed & {*values}:
        if values[name] != getattr(settings, name):
            fix = f"Make the result anew: {name} is {getattr(settings, name)} now."
            raise ConfigError(f"{name} is no longer an option", value=values[name], fix=fix)
    return settings(**{name: value for name, value in values.items() if name not in fixed})


def check_names(names: Iterable[str], options: Mapping[str, Option], moved: Mapping[str, str], flag: str = "") -> None:
    """Raise ConfigError unless every name, with groups and dots, is one of an option that can be set.

    The error tells which option was probably meant, or that it has moved, or is a constant. `moved` has the names of
    former options, and of each the option it is now, or a sentence; `flag` is what stands before names, "--" on the
    command line.
    """
    for name in names:
        if name in moved:
            raise ConfigError("this option has moved", value=flag + name, fix=_where(name, moved, flag))
        option = options.get(name) or _within_a_value(name, options)
        if option is None:
            near = nearest(name, [*(key for key in options if not options[key].is_fixed), *moved])
            fix = None if near is None else f"Did you mean {flag}{near}?"
            if near is not None and near in moved:
                fix = _where(near, moved, flag)
            raise ConfigError("there is no such option", value=flag + name, fix=fix)
        if option.is_fixed:
            problem = f"this is no option but a constant, {option.default}"
            raise ConfigError(problem, value=flag + name, fix=f"It is {option.text}")


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The name that a wrong one was probably meant to be: spelt alike, or the same in another group; or None."""
    known = [*names]
    last = name.rpartition(".")[2]
    same = [other for other in known if other.rpartition(".")[2] == last]
    found = difflib.get_close_matches(name, same, 1, 0) or difflib.get_close_matches(name, known, 1, 0.6)
    if not found:
        by_last = {other.rpartition(".")[2]: other for other in reversed(known)}
        found = [by_last[other] for other in difflib.get_close_matches(last, by_last, 1, 0.75)]
    return found[0] if found else None


def names_in(content: Any, options: Mapping[str, Option], prefix: str = "") -> Iterator[str]:
    """Names of the options that a file's content sets, (nested) mappings as a YAML file holds them.

    Raises ConfigError if the value of a group is no mapping, or of a setting is missing.
    """
    for key, value in content.items():
        name = f"{prefix}{key}"
        if name in options and options[name].is_group:
            if not isinstance(value, dict):
                fix = f"Write its settings as `{key}: {{setting: value}}`."
                raise ConfigError(f"{name} is a group of settings", value=value, fix=fix)
            yield from names_in(value, options, f"{name}.")
        elif name not in options and isinstance(value, dict):
            yield from (names_in(value, options, f"{name}.") if value else [name])
        else:
            if value is None and name in options and not options[name].may_be_none:
                raise ConfigError(f"{name} has no value", fix="Give it one, or leave it out.")
            yield name


def short_lines(options: Mapping[str, Option]) -> str:
    """Options by their flags: of each the first sentence of what it is, and its default."""
    width = min(_NAME_WIDTH, max(map(len, options)) + 4)
    rows = []
    for flag, option in options.items():
        sentence = re.split(r"(?<!Sec)\. (?=[^a-z])|\.$", option.text, maxsplit=1)[0]
        rows.append(_row(flag, f"{sentence}{_default(option)}", width))
    return "\n".join(rows)


def grouped(options: Iterable[Option]) -> str:
    """All of some options with all that is said of them, those of one group together."""
    lines = []
    group = None
    for option in options:
        if option.is_fixed:
            continue
        if option.is_group:
            lines += ["", _filled(f"{option.name}: {option.text}")]
            group = option.name
            continue
        own = option.name.rpartition(".")[0]
        if own != group:  # back from a group within it
            lines += ["", f"{own}:" if own else ""]
            group = own
        lines.append(_row(f"--{option.name}", option.text.removesuffix(".") + _default(option)))
    text = "\n".join(lines)
    return re.sub(r"\n{3,}", "\n\n", text).strip("\n")


def _row(flag: str, text: str, name_width: int = _NAME_WIDTH) -> str:
    start = f"  {flag:<{name_width - 2}}"
    if len(start) > name_width or not start.endswith(" "):
        start = f"{start.rstrip()}  "
    return _filled(text, start, " " * name_width)


def _filled(text: str, start: str = "", indent: str = "") -> str:
    width = max(60, min(WIDTH, shutil.get_terminal_size((WIDTH, 0)).columns))
    breaks: dict[str, Any] = {"break_on_hyphens": False, "break_long_words": False}
    return textwrap.fill(text, width, initial_indent=start, subsequent_indent=indent, **breaks)


def _default(option: Option) -> str:
    return f" (default {option.default})" if option.default else ""


def _where(name: str, moved: Mapping[str, str], flag: str) -> str:
    place = moved[name]
    return place if " " in place else f"It is {flag}{place} now."


def _within_a_value(name: str, options: Mapping[str, Option]) -> Option | None:
    """The option that a longer name belongs to: one whose value is itself a mapping, such as a known distance."""
    while "." in name:
        name = name.rpartition(".")[0]
        if name in options:
            return None if options[name].is_group else options[name]
    return None


def _texts(settings: type) -> dict[str, str]:
    """What the docstrings of a dataclass, and of those it extends, say of each field."""
    texts: dict[str, str] = {}
    for base in reversed(settings.__mro__):
        name = ""
        inside = False
        for line in inspect.cleandoc(vars(base).get("__doc__") or "").splitlines():
            if line and not line.startswith(" "):
                inside = line in ("Args:", "Attributes:")
            elif inside and (start := re.match(r" {4}(\w+): (.*)", line)):
                name = start[1]
                texts[name] = start[2]
            elif inside and line.strip() and name:
                texts[name] += f" {line.strip()}"
    return texts


def _shown(value: object) -> str:
    if value in (None, "", ()):
        return ""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_shown, value))}]"
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value).lower() if isinstance(value, bool) else str(value)
