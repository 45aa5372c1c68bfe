"""What one client shows, as a short text for links and `--state`."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from typing import Self
from urllib.parse import parse_qs, urlsplit

from wheretolook.utils.errors import ConfigError

MAX_VIEWS = 20
MAX_NUMBER = 1e9
_MAX_LENGTH = 2000  # characters
_FIX = "Copy it from the field `state` of the viewer, such as n=3;height=1.4;place=1,2,1.5."


@dataclass(frozen=True)
class ViewState:
    """Choices of one client, in metres and degrees in the world, z up; None leaves a choice to the viewer.

    The text holds the fields that differ from their default, "method=set;n=3;place=1,2,1.5", and needs no escaping in
    a link.
    """

    method: str = ""  # the best weights' method by default
    occlusion: str = ""  # the best available by default
    n: int = 5  # best views per location
    threshold: float = 0.5  # score from which a view is good
    height: float | None = None  # of the floor
    cut: float | None = None  # height above which the scene is hidden
    place: tuple[float, float, float] | None = None  # selected location
    yaw: float | None = None  # of the selected view
    pitch: float | None = None
    eye: tuple[float, float, float] | None = None  # of the browser's camera
    target: tuple[float, float, float] | None = None  # of the browser's camera

    def text(self) -> str:
        """Return the state as text."""
        parts = []
        for item in fields(self):
            value = getattr(self, item.name)
            if value != item.default:
                values = value if isinstance(value, tuple) else (value,)
                parts.append(f"{item.name}={','.join(map(_short, values))}")
        return ";".join(parts)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse the text of a state. Raises ConfigError for an unknown field or an invalid value."""
        if len(text) > _MAX_LENGTH:
            raise ConfigError("the state is too long", value=f"{text[:60]}...", fix=_FIX)
        values: dict[str, object] = {}
        for part in filter(None, text.split(";")):
            name, _, value = part.partition("=")
            try:
                values[name] = _parse_value(name, value)
            except ValueError as error:
                raise ConfigError("invalid view state", value=part, fix=_FIX) from error
        state = cls(**values)  # type: ignore[arg-type]
        if state.eye is not None and state.eye == state.target:
            raise ConfigError("eye and target of a view state must differ", value=state.eye, fix=_FIX)
        return state

    @classmethod
    def of_path(cls, path: str) -> Self | None:
        """Parse the state in the path of a request, "/?view=n=3;height=1.4"; None without one. Raises as `parse`."""
        values = parse_qs(urlsplit(path).query, separator="&").get("view")
        return cls.parse(values[0]) if values else None

    def link(self, host: str) -> str:
        """Return the address that opens the viewer at "host:port" in this state.

        The page connects to the address in the field `websocket`, which carries the state.
        """
        return f"http://{host}/?websocket=ws://{host}/?view={self.text()}"


def _short(value: object) -> str:
    """Format a value; numbers to the millimetre, however far a map is from its origin."""
    return f"{value:.3f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _parse_value(name: str, text: str) -> object:
    """Parse the value of a field. Raises ValueError if it is invalid."""
    kind = {item.name: str(item.type) for item in fields(ViewState)}.get(name, "")
    if kind == "str" and re.fullmatch(r"[\w.+-]{1,60}", text):
        return text
    if kind == "int" and 1 <= int(text) <= MAX_VIEWS:
        return int(text)
    numbers = tuple(map(float, text.split(",")))
    if kind.count("float") == len(numbers) and all(abs(number) <= MAX_NUMBER for number in numbers):
        return numbers if len(numbers) == 3 else numbers[0]
    raise ValueError(text)
