"""The scale of a map from photographs, in metres a unit: from markers, a known distance, or known positions."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.mapping.markers import Marker
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.reading import read_json_object

Source = Literal["markers", "distance", "positions", "model", "unknown"]
REPORT_FILE = "report.json"
_FLAT = 1e-6  # points whose second largest spread is below this share of the largest lie on a line


@dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale * rotation x + translation."""

    scale: float  # positive
    rotation: Float  # (3, 3)
    translation: Float  # (3,), in units of the target

    def apply(self, points: ArrayLike) -> Float:
        """Transform points (..., 3)."""
        return np.asarray(self.scale * np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation)

    def transform_model(self, model: Any) -> None:
        """Transform a `pycolmap.Reconstruction` in place."""
        import pycolmap

        model.transform(pycolmap.Sim3d(self.scale, pycolmap.Rotation3d(self.rotation), self.translation))


def fit_similarity(source: ArrayLike, target: ArrayLike) -> Similarity:
    """The similarity that takes points (N, 3) to points (N, 3) with the least sum of squares.

    Umeyama, "Least-Squares Estimation of Transformation Parameters Between Two Point Patterns", TPAMI 1991. Raises
    MapError for fewer than three points, or all on a line, which leaves the rotation about it open.
    """
    a = np.asarray(source, dtype=np.float64)
    b = np.asarray(target, dtype=np.float64)
    if len(a) < 3:
        raise MapError("a similarity needs three points", value=len(a), fix="Give the positions of more photographs.")
    mean_a = a.mean(0)
    mean_b = b.mean(0)
    for points in (a - mean_a, b - mean_b):
        spread = np.linalg.svd(points, compute_uv=False)
        if spread[1] <= _FLAT * max(spread[0], 1e-12):
            fix = "Give positions that are not on a line."
            raise MapError("positions on one line do not fix a frame", value=len(a), fix=fix)
    u, singular, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / ((a - mean_a) ** 2).sum(1).mean())
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


@dataclass(frozen=True)
class MapScale:
    """The scale of a map from photographs; `scale` in its `report.json`."""

    # What the scale comes from: "model" if it is that of a model of one's own, "unknown" if the map is not in metres.
    source: Source = "unknown"
    factor: float = 1.0  # metres in a unit of COLMAP's own frame; 1 if unknown
    # How far each marker's side (in percent) or photograph's position (in metres) is off; empty for a single distance.
    residuals: dict[str, float] = field(default_factory=dict)
    unit: Literal["percent", "m", ""] = ""  # of the residuals: "percent", "m", or "" where there are none
    unused: dict[str, str] = field(default_factory=dict)  # what was seen but could not be used, and why
    marker_error_px: dict[str, float] = field(default_factory=dict)  # root mean square over each marker's corners
    # Number of photographs that see each marker. Two alone cannot show that the marker was moved between them: some
    # place in the map fits both anyway.
    marker_views: dict[str, int] = field(default_factory=dict)

    @property
    def is_metric(self) -> bool:
        """Whether the map is in metres."""
        return self.source != "unknown"

    def describe(self) -> str:
        """One clause for a log."""
        if not self.is_metric:
            return "scale UNKNOWN: no markers, distance or positions were given, so lengths are not in metres"
        if self.source == "model":
            return "scale as in the model, its unit taken for a metre"
        text = f"scale from {self.source}"
        if self.residuals:
            off = np.abs(list(self.residuals.values()))
            text += f", off by {np.median(off):.3g} {self.unit} (median), {off.max():.3g} {self.unit} (most)"
        if self.marker_error_px:
            text += f", corners missed by {max(self.marker_error_px.values()):.2g} px at most"
        if self.marker_views and max(self.marker_views.values()) <= 2:
            text += "; NOT CHECKED: no marker is seen in more than two photographs"
        return text + (f"; not used: {', '.join(self.unused)}" if self.unused else "")


def scale_from_markers(
    markers: Sequence[Marker],
    size_m: Mapping[int, float] | float,
    tolerance_percent: float = 5.0,
    unused: Mapping[str, str] | None = None,
) -> MapScale:
    """The median of true size over length in the map, over the sides of all markers.

    `size_m` is the side of all markers, or of each by its id; `unused` are markers that could not be placed, and why.
    Raises MapError if there is no marker, or a side is off by more than the tolerance.
    """
    if not markers:
        reasons = "; ".join((unused or {}).values()) or "no marker of a known size was found"
        fix = "Check scale.dictionary and the sizes, and let at least two photographs see a marker whole."
        raise MapError("no marker gives the map its scale", value=reasons, fix=fix)
    sizes = [size_m if isinstance(size_m, float | int) else size_m[marker.marker_id] for marker in markers]
    lengths = np.stack([marker.sides for marker in markers])
    factor = float(np.median(np.array(sizes)[:, None] / lengths))
    off = 100 * (factor * lengths / np.array(sizes)[:, None] - 1)
    names = [f"marker {marker.marker_id}" for marker in markers]
    sides = [f"{name} side {side}" for name in names for side in range(4)]
    residuals = dict(zip(sides, off.ravel().tolist(), strict=True))
    if np.abs(off).max() > tolerance_percent:
        worst = np.flatnonzero(np.abs(off).max(1) > tolerance_percent)
        values = [f"{names[row]}: {' '.join(f'{value:+.1f}' for value in off[row])} %" for row in worst]
        problem = f"the markers do not agree on a scale: sides off by more than {tolerance_percent:g} %"
        fix = "Measure the black squares; give markers of different sizes in a marker_table."
        raise MapError(problem, value=", ".join(values), fix=fix)
    errors_px = dict(zip(names, (marker.error_px for marker in markers), strict=True))
    n_views = dict(zip(names, (len(set(marker.images)) for marker in markers), strict=True))
    return MapScale("markers", factor, residuals, "percent", dict(unused or {}), errors_px, n_views)


def scale_from_distance(first: ArrayLike, second: ArrayLike, distance_m: float) -> MapScale:
    """The scale at which two points (3,) of the map are `distance_m` apart. Raises MapError if they coincide."""
    length = float(np.linalg.norm(np.asarray(first) - np.asarray(second)))
    if not length > 0:
        raise MapError("the two ends of the known distance are in the same place", value=length, fix="Give others.")
    return MapScale("distance", distance_m / length)


def scale_from_positions(
    centers: Mapping[str, Float], positions: Mapping[str, Float], tolerance_percent: float = 5.0
) -> tuple[MapScale, Similarity]:
    """The scale, and the similarity that takes camera centres in the map to known positions in metres, by photograph.

    The tolerance is a share of the diagonal of the box around the positions used. Raises MapError if fewer than three
    photographs are in the map, all are on a line, or one is off by more.
    """
    names = [name for name in positions if name in centers]
    source = np.array([centers[name] for name in names]).reshape(-1, 3)
    target = np.array([positions[name] for name in names]).reshape(-1, 3)
    similarity = fit_similarity(source, target)
    off = np.linalg.norm(similarity.apply(source) - target, axis=1)
    unused = {name: "not in the map" for name in positions if name not in centers}
    residuals = dict(zip(names, off.tolist(), strict=True))
    limit_m = tolerance_percent / 100 * float(np.linalg.norm(np.ptp(target, axis=0)))
    if off.max() > limit_m:
        worst = sorted((name for name in names if residuals[name] > limit_m), key=lambda name: -residuals[name])
        off_by = f"off by more than {limit_m:.3g} m, {tolerance_percent:g} % of their extent"
        value = ", ".join(f"{name}: {residuals[name]:.3g} m" for name in worst[:5])
        fix = "The first is the worst: check its position, their units and names, or raise tolerance_percent."
        raise MapError(f"the positions do not agree with the map: {off_by}", value=value, fix=fix)
    return MapScale("positions", similarity.scale, residuals, "m", unused), similarity


def read_marker_table(path: Path) -> dict[int, float]:
    """Side in metres of each marker by its id, from a CSV file with the columns `id` and `size_m`.

    Raises ConfigError if the file is missing or not such a table, or a marker has two sizes.
    """
    sizes: dict[int, float] = {}
    for row in _rows(path, ("id", "size_m")):
        try:
            marker = int(row["id"])
            size = float(row["size_m"])
        except ValueError as error:
            raise ConfigError("not a marker's id and size", path=path, value=row, fix="Write 7,0.15.") from error
        if not 0 < size < np.inf:
            raise ConfigError("a marker's size must be positive", path=path, value=row)
        if sizes.setdefault(marker, size) != size:
            value = (sizes[marker], size)
            raise ConfigError(f"marker {marker} has two sizes", path=path, value=value, fix="Leave one of them.")
    return sizes


def read_positions(path: Path) -> dict[str, Float]:
    """Positions (3,) in metres by photograph: CSV with columns `image`, `x`, `y`, `z`, or JSON `{image: [x, y, z]}`.

    Raises ConfigError if the file is missing or not such a table, or a photograph has two positions.
    """
    if path.suffix.lower() == ".json":
        try:
            rows = list(read_json_object(path).items())
        except (OSError, ValueError, AttributeError) as error:
            raise ConfigError(f"not a file of positions: {error}", path=path, fix="{image: [x, y, z]}") from error
    else:
        rows = [(row["image"], [row["x"], row["y"], row["z"]]) for row in _rows(path, ("image", "x", "y", "z"))]
    positions: dict[str, Float] = {}
    for name, values in rows:
        try:
            at = np.array(values, dtype=np.float64)
        except (TypeError, ValueError):
            at = np.zeros(0)
        if at.shape != (3,) or not np.isfinite(at).all():
            raise ConfigError("not a position", path=path, value=(name, values), fix="Give x, y, z in metres.")
        if not np.array_equal(positions.setdefault(name, at), at):
            raise ConfigError("a photograph has two positions", path=path, value=name, fix="Leave one of them.")
    return positions


def read_scale(map_dir: Path) -> MapScale | None:
    """The scale in a map's report; None for maps of known poses, which are metric. MapError if it is damaged."""
    path = map_dir / REPORT_FILE
    try:
        scale = read_json_object(path).get("scale")
        return None if scale is None else _of_record(scale)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise MapError(f"the map's report is damaged: {error}", path=path, fix="Run the map stage again.") from error


def _of_record(scale: Mapping[str, Any]) -> MapScale:
    """The scale of a report. Raises TypeError, ValueError or AttributeError if it is none."""
    found = MapScale(**scale)
    if found.source not in get_args(Source) or not 0 < found.factor < np.inf:
        raise ValueError(f"a scale of {found.factor} by {found.source}")
    for values in (found.residuals, found.marker_error_px, found.marker_views):
        if not np.isfinite([float(value) for value in values.values()]).all():
            raise ValueError("a residual is not finite")
    unit_fits = found.unit in ("percent", "m") or not found.residuals
    if not unit_fits or not isinstance(found.unused, Mapping):
        raise ValueError(f"residuals in {found.unit}, of {found.unused} unused")
    return found


def _rows(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            rows = [{name: (row[name] or "").strip() for name in columns} for row in reader]
    except (OSError, UnicodeDecodeError, KeyError, csv.Error) as error:
        problem = f"not a table with the columns {', '.join(columns)}: {error}"
        raise ConfigError(problem, path=path, fix="Write a CSV file with them.") from error
    if not rows:
        raise ConfigError("the table is empty", path=path, value=0, fix=f"Its columns are {', '.join(columns)}.")
    return rows
