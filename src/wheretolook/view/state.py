"""What somebody looks at, as a short text: in a link, and for `--state`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, fields
from typing import Self
from urllib.parse import parse_qs, urlsplit

from wheretolook.utils.errors import ConfigError

MOST_VIEWS = 20
_LONGEST = 2000  # characters; a longer one is no state of ours


@dataclass(frozen=True)
class ViewState:
    """The choices of one who looks.

    Metres and degrees in the world, z up; None stands for what the viewer chooses. The text has a field each that is
    not as it is by default, "method=set;n=3;place=1,2,1.5": nothing in it must be escaped in a link.
    """

    method: str = ""  # that of the best weights
    occlusion: str = ""  # the best there is
    n: int = 5  # best views of a place
    threshold: float = 0.5  # score from which a view is good enough
    height: float | None = None  # of the floor
    cut: float | None = None  # what lies above is left out
    place: tuple[float, float, float] | None = None  # the place looked at
    yaw: float | None = None  # of the camera turned by hand
    pitch: float | None = None
    eye: tuple[float, float, float] | None = None  # where the scene is seen from
    target: tuple[float, float, float] | None = None  # the point in the middle of the picture

    def text(self) -> str:
        """The state as a text."""
        parts = []
        for item in fields(self):
            value = getattr(self, item.name)
            if value != item.default:
                told = ",".join(map(_short, value)) if isinstance(value, tuple) else _short(value)
                parts.append(f"{item.name}={told}")
        return ";".join(parts)

    @classmethod
    def parse(cls, text: str) -> Self:
        """The state of a text. Raises ConfigError if it has a field that there is not, or a value that is none."""
        found: dict[str, object] = {}
        if len(text) > _LONGEST:
            raise ConfigError("the state of a view is a short text", value=f"{text[:60]}...", fix=_FIX)
        for part in filter(None, text.split(";")):
            name, _, value = part.partition("=")
            try:
                found[name] = _READ[name](value)
            except (KeyError, ValueError, TypeError) as error:
                raise ConfigError("this is no state of a view", value=part, fix=_FIX) from error
        state = cls(**found)  # type: ignore[arg-type]
        if state.eye is not None and state.eye == state.target:
            raise ConfigError("a scene is seen from elsewhere than the point looked at", value=state.eye, fix=_FIX)
        return state

    @classmethod
    def of_path(cls, path: str) -> Self | None:
        """The state in the path of a request, "/?view=n=3;height=1.4"; None if there is none. Raises as `parse`."""
        given = parse_qs(urlsplit(path).query, separator="&").get("view")
        return cls.parse(given[0]) if given else None

    def link(self, host: str) -> str:
        """The address that opens the viewer at "host:port" in this state.

        The page takes the address of its own connection from the field `websocket`, and so brings the state along.
        """
        return f"http://{host}/?websocket=ws://{host}/?view={self.text()}"


_FIX = "Copy it from the field `state` of the viewer, such as n=3;height=1.4;place=1,2,1.5."


def _short(value: object) -> str:
    """To the millimetre, however far a map lies from its origin."""
    return f"{value:.3f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value) or abs(value) > 1e9:
        raise ValueError(text)
    return value


def _point(text: str) -> tuple[float, float, float]:
    x, y, z = (_number(part) for part in text.split(","))
    return x, y, z


def _word(text: str) -> str:
    if not re.fullmatch(r"[\w.+-]{1,60}", text):
        raise ValueError(text)
    return text


def _count(text: str) -> int:
    value = int(text)
    if not 1 <= value <= MOST_VIEWS:
        raise ValueError(text)
    return value


_READ = {
    "method": _word, "occlusion": _word, "n": _count, "threshold": _number, "height": _number, "cut": _number,
    "place": _point, "yaw": _number, "pitch": _number, "eye": _point, "target": _point,
}  # fmt: skip
