"""Find the parts of a map that relocalize badly, so that they should be photographed again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from wheretolook.dataset.config import ACCURACY, Accuracy
from wheretolook.holdout.holdout import VIEWS, HoldoutResult, choose_blocks, hold_out_blocks, judged
from wheretolook.holdout.metrics import measure
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.holdout.scores import VISIBLE, Scoring, check_place, score_views
from wheretolook.mapping.colmap_model import observation_matrix
from wheretolook.mapping.georeference import DEPTH_M
from wheretolook.scorers.registry import is_probability
from wheretolook.utils.files import write_json, write_text
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import OcclusionModel

MIN_SHARED = 0.2
"""Two photographs show the same part if they share this fraction of the landmarks of the one that has fewer."""


@dataclass(frozen=True, eq=False)
class WeakPart:
    """Neighbouring photographs that do not localize without their block.

    Attributes:
        number: from 1, the part with most such photographs first.
        rows: of these photographs.
        n_tested: number of these, and of photographs that localize although they mostly show the same.
        n_left_out: photographs in the largest block that they were held out with.
        n_kept: landmarks that the rest of the map still has of those they observe, for the median photograph.
        center: median of their camera centres, in the model's own frame and unit.
        target: median of the landmarks they observe, likewise.
    """

    number: int
    rows: NDArray[np.int64]
    n_tested: int
    n_left_out: int
    n_kept: float
    center: tuple[float, float, float]
    target: tuple[float, float, float]

    def record(self, names: list[str]) -> dict[str, Any]:
        """JSON values; photographs by their names."""
        record = {**vars(self), "photographs": [names[row] for row in self.rows]}
        del record["rows"]
        return record

    def describe(self, names: list[str], unit: str) -> str:
        """Describe the part in one sentence."""
        listed = ", ".join(names[row] for row in self.rows[:4])
        if len(self.rows) > 4:
            listed += f" and {len(self.rows) - 4} more"
        near, look = (" ".join(f"{value:.2f}" for value in place) for place in (self.center, self.target))
        return (
            f"near ({near}) {unit}, looking at ({look}): {len(self.rows)} of {self.n_tested} photographs fail to "
            f"localize without their block of {self.n_left_out}; the rest of the map has {self.n_kept:.0f} of the "
            f"landmarks they show: {listed}"
        )


def weak_parts(source: PhotographedMap, results: list[HoldoutResult], views: pd.DataFrame) -> list[WeakPart]:
    """Group the photographs that fail in the blocks that partition all photographs; those that share landmarks join."""
    tested = views[views["is_part"]]
    rows = tested["row"].to_numpy()
    good = tested["good"].to_numpy(dtype=bool)
    if good.all():
        return []
    observes = observation_matrix(source.arrays, source.rig_frame)[source.rig_frame[rows]]
    shared = np.asarray((observes @ observes.T).toarray())
    counts = np.maximum(np.diag(shared), 1)
    alike = shared >= MIN_SHARED * np.minimum(counts[:, None], counts)
    bad = np.flatnonzero(~good)
    _, label = connected_components(alike[np.ix_(bad, bad)], directed=False)
    sizes = {one.block.number: len(one.block.held_out) for one in results}
    to_frame = source.from_model
    parts = []
    for group in np.unique(label):
        members = bad[label == group]
        same_part = alike[members].any(0)
        same_part[members] = True
        observed = np.flatnonzero(np.asarray(observes[members].sum(0)).reshape(-1))
        target = np.median(source.arrays.points[observed], axis=0)
        target = (target - to_frame.translation) @ to_frame.rotation / to_frame.scale
        parts.append(
            WeakPart(
                number=0,
                rows=rows[members],
                n_tested=int(same_part.sum()),
                n_left_out=max(sizes[block] for block in tested["block"].to_numpy()[members]),
                n_kept=float(np.median(tested["n_kept"].to_numpy()[members])),
                center=tuple(np.median(source.own_centers[rows[members]], axis=0).tolist()),
                target=tuple(target.tolist()),
            )
        )
    parts.sort(key=lambda part: (-len(part.rows), int(part.rows[0])))
    return [replace(part, number=number) for number, part in enumerate(parts, 1)]


MAX_PRINTED = 5  # all are in the files
MIN_IN_RANGE = 0.5  # share of the views
MIN_AUC = 0.7
MAX_ECE = 0.08  # calibration error; of rendered scenes about 0.03


@dataclass(frozen=True, eq=False)
class CheckReport:
    """All results of a check.

    Attributes:
        source: the map.
        method: the method that is checked.
        views: a row for each photograph of each block, see `scores.score_views`.
        photographs: a row for each photograph; `check.csv`.
        blocks: a row for each block; `blocks.csv`.
        numbers: see `metrics.measure`.
        parts: parts of the map that relocalize badly.
        accuracy: up to which a photograph counts as localized.
    """

    source: PhotographedMap
    method: str
    views: pd.DataFrame
    photographs: pd.DataFrame
    blocks: pd.DataFrame
    numbers: dict[str, Any]
    parts: list[WeakPart]
    accuracy: Accuracy = ACCURACY

    def save(self, folder: Path) -> None:
        """Write check.csv, blocks.csv, views.csv and check.json into a folder."""
        for name, table in (("check", self.photographs), ("blocks", self.blocks), ("views", self.views)):
            write_text(folder / f"{name}.csv", table.to_csv(index=False, float_format="%.6g"))
        content = {
            "map": self.source.name,
            "model": str(self.source.path),
            "method": self.method,
            "in_metres": self.source.is_metric,
            "turned_upright": self.source.is_turned,
            "limits": self.limits(),
            "fov_deg": self.source.fov_deg,
            "says": self.sentence(),
            "advice": self.advice(),
            "n_photographs": len(self.source.poses),
            **self.numbers,
            "weak_parts": [part.record(self.source.names) for part in self.parts],
        }
        write_json(folder / "check.json", content)

    def limits(self) -> str:
        """Name the errors up to which a photograph counts as localized."""
        metres, degrees = self.accuracy
        if self.source.is_metric:
            return f"{100 * metres:g} cm and {degrees:g} degrees"
        return f"{100 * metres / DEPTH_M:g} % of the median depth and {degrees:g} degrees"

    def sentence(self) -> str:
        """State how often the better of two views is picked, or why that is unknown."""
        n_views = self.numbers["n_views"]
        n_localized = self.numbers["n_localized"]
        if n_localized in (0, n_views):
            count = "all" if n_localized else "none"
            return f"{count} of the {n_views} held-out views localize (within {self.limits()}): no better one to pick"
        return (
            f"of two views, one that localizes and one that does not, {self.method} picks the better one "
            f"{self._auc(self.method)}, counting visible landmarks {self._auc(VISIBLE)}"
        )

    def advice(self) -> str:
        """State whether to trust the scores on this map, to adapt them, or not to use them."""
        numbers = self.numbers
        auc = numbers["methods"][self.method]["auc"]
        if numbers["share_in_range"] < MIN_IN_RANGE:
            return "do not use these scores: most views are outside the range of the training views"
        if auc["value"] is None:
            return "whether to trust the order of the scores is unknown"
        if auc["value"] < MIN_AUC:
            return "do not use these scores: they hardly order the views of this map"
        if numbers["ece"] and numbers["ece"]["value"] > MAX_ECE:
            return "trust the order of the scores, not their values: `wheretolook adapt` corrects these on this map"
        return "trust the scores" if numbers["ece"] else "trust the order of the scores"

    def _auc(self, method: str, name: str = "auc") -> str:
        auc = self.numbers["methods"][method][name]
        value, *interval = _with_interval(auc, 0, 100).split(" ", 1)
        return " ".join([value, "times in 100", *interval])

    def lines(self) -> list[str]:
        """Return the report for the screen: the sentence first."""
        numbers = self.numbers
        source = self.source
        mine, visible = (numbers["methods"][name] for name in (self.method, VISIBLE))
        lines = [
            self.sentence(),
            self.advice(),
            f"{numbers['n_localized']} of {numbers['n_views']} views in {numbers['n_blocks']} blocks localize within "
            f"{self.limits()}; {len(source.poses)} photographs",
        ]
        lines += [f"{name} picks the better one {self._auc(name)}" for name in numbers["methods"]][1:-1]
        if mine["auc_within_blocks"]["value"] is not None:
            auc, baseline = (self._auc(name, "auc_within_blocks") for name in (self.method, VISIBLE))
            lines.append(f"of two views of the same block: {auc}, counting visible landmarks {baseline}")
        lines.append(
            f"regret: {_with_interval(mine['regret'], 1)} points, by visible landmarks "
            f"{_with_interval(visible['regret'], 1)}, at {numbers['n_places']} places with several views "
            f"({numbers['n_places_of_both_kinds']} with a choice)"
        )
        if numbers["ece"]:
            lines.append(
                f"calibration error: {_with_interval(numbers['ece'], 3)}; {100 * numbers['mean_probability']:.0f} % "
                f"predicted, {100 * numbers['share_localized']:.0f} % localize"
            )
        if ratios := numbers["inliers_found_over_expected"]:
            good, every = (_with_interval(ratios[name], 2) for name in ("localized", "all"))
            lines.append(f"inliers over expected: {good} of views that localize, {every} of all")
        if source.fov_deg is not None:
            lines.append(f"views of {source.fov_deg:g} degrees, {source.n_crops} of each photograph")
        if numbers["share_in_range"] < 1:
            lines.append(f"{100 * (1 - numbers['share_in_range']):.0f} % of the views are outside the training range")
        if source.is_turned:
            lines.append("the model was turned upright; --up states another direction, --up z keeps the model's")
        if not source.is_metric:
            lines.extend(source.frame.doubts[:1])
        if not self.parts:
            return [*lines, "no part of the map fails without its neighbours"]
        lines.append(f"photograph again ({len(self.parts)} parts relocalize badly, {source.unit}):")
        lines += [f"  {part.number}. {part.describe(source.names, source.unit)}" for part in self.parts[:MAX_PRINTED]]
        if len(self.parts) > MAX_PRINTED:
            lines.append(f"  and {len(self.parts) - MAX_PRINTED} more: column part of check.csv")
        return lines


def check_map(
    source: PhotographedMap,
    work: Path,
    scoring: Scoring = Scoring(),
    occlusion: OcclusionModel | None = None,
    views: int = VIEWS,
    workers: int = 1,
    device: str = "cpu",
) -> CheckReport:
    """Hold blocks of a map's photographs out, localize them against the rest, score them, and compare.

    Finished blocks are cached in `work`. The default occlusion model is hidden-point removal; at most `views` of a
    block are localized. Raises MapError if blocks leave no map; WeightsError if weights cannot be used.
    """
    check_place(source, scoring, device)
    accuracy = scoring.accuracy or ACCURACY
    results = hold_out_blocks(source, work, choose_blocks(source, views), workers, device)
    results = [judged(result, accuracy) for result in results]
    method, scored = score_views(source, results, scoring, occlusion or HiddenPointRemoval(), device)
    columns = {method: "score", **{name: name for name in (*scoring.also, VISIBLE) if name != method}}
    columns[VISIBLE] = columns.pop(VISIBLE)  # the baseline comes last
    centers = (source.own_centers * source.from_model.scale)[scored["row"].to_numpy()]
    numbers = measure(scored, columns, centers, source.place_radius, is_probability(method))
    middle = scored[scored["crop"] == 0]
    parts = weak_parts(source, results, middle)
    photographs = _photographs(source, middle, parts)
    blocks = _blocks(source, results, scored)
    return CheckReport(source, method, scored, photographs, blocks, numbers, parts, accuracy)


def _photographs(source: PhotographedMap, views: pd.DataFrame, parts: Sequence[WeakPart]) -> pd.DataFrame:
    """Tabulate the photographs: pose, how often held out and localized, and the result in the block of the partition.

    Results are empty for photographs that were not tested.
    """
    rows = range(len(source.poses))
    axes = source.poses[:, 2, :3] @ source.from_model.rotation  # in the model's own frame
    times = views.groupby("row")["good"].agg(["size", "sum"]).reindex(rows, fill_value=0).astype(int)
    once = views[views["is_part"]].set_index("row").reindex(rows)
    counts = once[["block", "good", "in_range", "n_visible", "n_matches", "n_inliers", "n_observed", "n_kept"]]
    counts = counts.astype("Float64").astype("Int64")
    part_of = np.zeros(len(rows), dtype=np.int64)
    for part in parts:
        part_of[part.rows] = part.number
    return pd.DataFrame(
        {
            "photograph": source.names,
            **dict(zip("xyz", source.own_centers.T, strict=True)),
            **{f"look_{name}": values for name, values in zip("xyz", axes.T, strict=True)},
            "times_left_out": times["size"],
            "times_localized": times["sum"],
            "block": counts["block"],
            "localized": counts["good"],
            "score": once["score"],
            "in_range": counts["in_range"],
            "error": once["error_m"] / source.from_model.scale,
            "error_deg": once["error_deg"],
            "limit": once["limit_m"] / source.from_model.scale,
            **counts[["n_visible", "n_matches", "n_inliers", "n_observed", "n_kept"]],
            "expected_inliers": once["expected_inliers"],
            "part": part_of,
        }
    )


def _blocks(source: PhotographedMap, results: Sequence[HoldoutResult], views: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the blocks: numbers of photographs and landmarks, predictions and results."""
    rows = []
    for one in results:
        block = one.block
        of_block = views[views["block"] == block.number]
        medians = of_block[["n_kept", "n_inliers", "expected_inliers"]].median()
        rows.append(
            {
                "block": block.number,
                "kind": "part" if block.is_part else "grown",
                "left_out": len(block.held_out),
                "looked_at": len(of_block),
                "localized": int(of_block["good"].sum()),
                "share_localized": of_block["good"].mean(),
                "mean_score": of_block["score"].mean(),
                "landmarks": len(one.landmarks),
                "median_kept": medians["n_kept"],
                "median_inliers": medians["n_inliers"],
                "median_expected_inliers": medians["expected_inliers"],
                **dict(zip("xyz", np.median(source.own_centers[block.held_out], axis=0), strict=True)),
                "first": source.names[block.held_out[0]],
                "last": source.names[block.held_out[-1]],
            }
        )
    return pd.DataFrame(rows)


def _with_interval(measured: dict[str, float | None], digits: int, scale: float = 1) -> str:
    value, low, high = ("unknown" if end is None else f"{scale * end:.{digits}f}" for end in measured.values())
    return value if measured["low"] is None else f"{value} [{low}, {high}]"
