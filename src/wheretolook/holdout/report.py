"""Report of a check: sentences, tables and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.thresholds import ACCURACY, Accuracy
from wheretolook.holdout.holdout import HoldoutResult, hold_out_blocks, judged
from wheretolook.holdout.holdout_blocks import VIEWS, choose_blocks
from wheretolook.holdout.metrics import measure
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.holdout.scores import VISIBLE, Scoring, check_place, score_views
from wheretolook.holdout.weak_regions import WeakPart, weak_parts
from wheretolook.mapping.georeference import DEPTH_M
from wheretolook.scorers.registry import is_probability
from wheretolook.utils.files import write_json, write_text
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import OcclusionModel

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
            lines.extend(source.own_frame.doubts[:1])
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
