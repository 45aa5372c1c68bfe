"""What a page shows: the choices of one client as a short text, and paths read from files."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self
from urllib.parse import parse_qs, urlsplit

import numpy as np

from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.geometry.similarity import Similarity
from wheretolook.geometry.views import Views
from wheretolook.mapping.map_frame import IDENTITY
from wheretolook.planning.config import FORWARD
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.files import read_parquet

MAX_VIEWS = 20
MAX_NUMBER = 1e9
_STATE_FIX = "Copy it from the field `state` of the viewer, such as n=3;height=1.4;place=1,2,1.5."

_PATH_FIX = """\
Give the folder or path.csv of `wheretolook plan`, a scene's folder in results/paths of `wheretolook compare-paths`, a
TUM trajectory (t x y z qx qy qz qw, camera-to-world), or a CSV of selected views."""


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
        if len(text) > 2000:
            raise ConfigError("the state is too long", value=f"{text[:60]}...", fix=_STATE_FIX)
        values: dict[str, object] = {}
        for part in filter(None, text.split(";")):
            name, _, value = part.partition("=")
            try:
                values[name] = _parse_value(name, value)
            except ValueError as error:
                raise ConfigError("invalid view state", value=part, fix=_STATE_FIX) from error
        state = cls(**values)  # type: ignore[arg-type]
        if state.eye is not None and state.eye == state.target:
            raise ConfigError("eye and target of a view state must differ", value=state.eye, fix=_STATE_FIX)
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


Paths = dict[str, Views]
"""Views along paths by method; `good` is whether each localized, None if unknown."""


def read_paths(path: Path, pair: int = 0, world_from_map: Similarity = IDENTITY.world_from_map) -> Paths:
    """Read the views along a path by method; of compared paths those of one start-goal pair.

    Poses are moved from the map's own frame to the world. A single path is accompanied by `FORWARD`: the same locations
    seen by a camera that looks ahead. Raises TableError if the file is missing or has no valid poses.
    """
    if path.is_dir():
        path = next((path / name for name in ("path.csv", "views.parquet") if (path / name).is_file()), path)
    if path.suffix == ".parquet":
        paths = _compared_paths(path, pair)
    else:
        paths = {"planned" if path.name == "path.csv" else path.stem: Views.read(path)}
    if not 1 <= len(paths) <= 20:
        problem = "1 to 20 methods can be shown"
        raise TableError(problem, path=path, value=len(paths), fix="Correct --pair, or leave out methods.")
    for along in paths.values():
        finite = (np.abs(along.cam_from_world) < MAX_NUMBER).all()  # False for NaN
        if not 2 <= len(along) <= 5000 or not finite:
            raise TableError("a path has 2 to 5000 finite poses", path=path, value=len(along), fix=_PATH_FIX)
    place = world_from_map.apply_to_poses
    paths = {name: replace(along, cam_from_world=place(along.cam_from_world)) for name, along in paths.items()}
    if len(paths) == 1:
        (only,) = paths.values()
        return {FORWARD: Views(looking_ahead(only.positions)), **paths}
    return paths


def looking_ahead(positions: Float) -> Float:
    """Return level poses (W, 3, 4) at positions (W, 3) m that look along the path; stationary ones keep direction."""
    steps = np.diff(positions, axis=0, append=positions[-1:])
    steps[:, 2] = 0
    moving = np.flatnonzero(np.linalg.norm(steps, axis=1) >= 1e-6)
    if len(moving) == 0:
        return poses_looking_along(positions, np.tile((1.0, 0.0, 0.0), (len(positions), 1)))
    last = np.searchsorted(moving, np.arange(len(steps)), side="right") - 1  # the first direction before any motion
    return poses_looking_along(positions, steps[moving[np.maximum(last, 0)]])


def _compared_paths(path: Path, pair: int) -> Paths:
    """Read the paths that every method planned, or its views along the given path if any method planned none."""
    from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses

    try:
        table = read_parquet(path)
        all_scenes = path.parent.parent / path.name  # has labels, too
        if all_scenes.is_file():
            labelled = read_parquet(all_scenes)
            labelled = labelled[labelled["scene"] == path.parent.name]
            table = labelled if len(labelled) else table
        table = table[table["pair"] == pair].sort_values("waypoint", kind="stable")
        methods = [name for name in table["method"].unique() if " " not in name]  # others name a second selection rule
        planned = table[table["task"] == "planned"]
        chosen = planned if {*methods} <= {*planned["method"]} else table[table["task"] == "given"]
        paths = {}
        for name in methods:
            rows = chosen[chosen["method"] == name]
            has_labels = "status" in rows and not (rows["status"] == UNLABELLED).any()
            # a view counts as localized within 25 cm and 2 degrees, as in compared paths
            good = is_good(rows, 0.25, 2.0) if has_labels else None
            paths[str(name)] = Views(poses(rows), method=str(name), good=good)
        return paths
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TableError(f"no path can be read: {error}", path=path, fix=_PATH_FIX) from error
