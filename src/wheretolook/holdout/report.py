"""What a check found: sentences, tables and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.evaluation.scores import is_probability
from wheretolook.holdout.holdout import LeftOut
from wheretolook.holdout.metrics import PLACE_OF_DEPTH, measure
from wheretolook.holdout.photo_map import DEPTH_M, MAX_ERROR_DEG, MAX_ERROR_M, MAX_ERROR_OF_DEPTH, PhotographedMap
from wheretolook.holdout.scores import VISIBLE
from wheretolook.holdout.weak_regions import WeakPart, weak_parts
from wheretolook.utils.files import write_json, write_text

PARTS_TOLD = 5  # on the screen; all are in the files


@dataclass(frozen=True, eq=False)
class CheckReport:
    """All that a check found."""

    source: PhotographedMap
    method: str  # the one that is checked
    views: pd.DataFrame  # one row for each photograph of each block; see `scores.score_views`
    photographs: pd.DataFrame  # one row for each photograph; `check.csv`
    blocks: pd.DataFrame  # one row for each block; `blocks.csv`
    numbers: dict[str, Any]  # see `numbers.measure`
    parts: list[WeakPart]

    def save(self, folder: Path) -> None:
        """Write check.csv, blocks.csv, views.csv and check.json into a folder."""
        write_text(folder / "check.csv", self.photographs.to_csv(index=False, float_format="%.6g"))
        write_text(folder / "blocks.csv", self.blocks.to_csv(index=False, float_format="%.6g"))
        write_text(folder / "views.csv", self.views.to_csv(index=False, float_format="%.6g"))
        parts = [
            {**vars(part), "rows": None, "photographs": [self.source.names[row] for row in part.rows]}
            for part in self.parts
        ]
        for part in parts:
            part.pop("rows")
        record: dict[str, Any] = {"map": self.source.name, "model": str(self.source.path), "method": self.method}
        record |= {
            "in_metres": self.source.is_metric,
            "turned_upright": self.source.is_turned,
            "limits": self.limits(),
            "says": self.sentence(),
        }
        record |= {"n_photographs": len(self.source.poses), **self.numbers, "weak_parts": parts}
        write_json(folder / "check.json", record)

    def limits(self) -> str:
        """Up to which error a photograph counts as localized."""
        if self.source.is_metric:
            return f"{100 * MAX_ERROR_M:g} cm and {MAX_ERROR_DEG:g} degrees"
        return f"{100 * MAX_ERROR_OF_DEPTH:g} % of the median depth and {MAX_ERROR_DEG:g} degrees"

    def sentence(self) -> str:
        """How often of two views the better one is picked, or why that cannot be told."""
        numbers = self.numbers
        if numbers["n_localized"] in (0, numbers["n_views"]):
            all_or_none = "all" if numbers["n_localized"] else "none"
            return (
                f"{all_or_none} of the {numbers['n_views']} views that were left out localize (within {self.limits()}),"
                " so there is no better one to pick"
            )
        mine, other = (numbers["methods"][name]["auc"] for name in (self.method, VISIBLE))
        return (
            f"of two views, one that localizes and one that does not, {self.method} picks the better one "
            f"{_times(mine)}, counting visible landmarks {_times(other)}"
        )

    def lines(self) -> list[str]:
        """What is said on the screen: the sentence first."""
        numbers = self.numbers
        source = self.source
        found = [self.sentence()]
        found.append(
            f"{numbers['n_localized']} of {numbers['n_views']} views in {numbers['n_blocks']} blocks localize within "
            f"{self.limits()}; {len(source.poses)} photographs"
        )
        mine = numbers["methods"][self.method]
        if mine["auc_within_blocks"]["value"] is not None:
            theirs = numbers["methods"][VISIBLE]["auc_within_blocks"]
            found.append(
                f"of two views of the same block, against the same map: {_times(mine['auc_within_blocks'])}, "
                f"counting visible landmarks {_times(theirs)}"
            )
        if numbers["n_places_of_both_kinds"]:
            regrets = [f"{_told(mine['regret'], 1)} points"]
            if self.method != VISIBLE:
                regrets.append(f"by visible landmarks {_told(numbers['methods'][VISIBLE]['regret'], 1)}")
            found.append(
                f"regret at {numbers['n_places']} places that several views share ({numbers['n_places_of_both_kinds']} "
                f"with a choice to make): {', '.join(regrets)}"
            )
        else:
            found.append(f"regret: none of {numbers['n_places']} places that several views share has a choice to make")
        if numbers["ece"]:
            found.append(
                f"calibration error {_told(numbers['ece'], 3)}: {100 * numbers['mean_probability']:.0f} % were "
                f"predicted, {100 * numbers['share_localized']:.0f} % localize"
            )
        ratios = numbers["inliers_found_over_expected"]
        if ratios:
            found.append(
                f"inliers found over expected: {_told(ratios['localized'], 2)} of views that localize, "
                f"{_told(ratios['all'], 2)} of all"
            )
        if numbers["share_in_range"] < 1:
            found.append(
                f"{100 * (1 - numbers['share_in_range']):.0f} % of the views are unlike those that were learnt from"
            )
        if source.is_turned:
            found.append(
                "the model was turned upright for this; other commands take its z for up: "
                "`wheretolook map --model` with --map.existing.level true"
            )
        if not self.parts:
            found.append("no part of the map fails without its neighbours")
        else:
            found.append(f"photograph again ({len(self.parts)} parts relocalize badly, {source.unit}):")
            for part in self.parts[:PARTS_TOLD]:
                found.append(f"  {part.number}. {part.describe([source.names[row] for row in part.rows], source.unit)}")
            if len(self.parts) > PARTS_TOLD:
                found.append(f"  and {len(self.parts) - PARTS_TOLD} more: column part of check.csv")
        return found


def make_report(
    source: PhotographedMap, left_out: Sequence[LeftOut], method: str, views: pd.DataFrame, also: Sequence[str] = ()
) -> CheckReport:
    """Measure, and find the parts that relocalize badly, by the views that `score_views` has scored."""
    others = [name for name in also if name not in (method, VISIBLE)]
    methods = [method, *others, *([VISIBLE] if method != VISIBLE else [])]
    columns = ["score" if name == method else name for name in methods]
    centers = (source.own_centers * source.from_model.scale)[views["row"].to_numpy()]
    numbers = measure(views, methods, columns, centers, place_radius(source), is_probability(method))
    parts = weak_parts(source, list(left_out), views)
    return CheckReport(
        source, method, views, _photographs(source, views, parts), _blocks(source, left_out, views), numbers, parts
    )


def place_radius(source: PhotographedMap) -> float:
    """How far apart the cameras of views are at most that share a place, see `PLACE_OF_DEPTH`."""
    return PLACE_OF_DEPTH * (DEPTH_M if not source.is_metric else float(np.nanmedian(source.depth_m)))


def _photographs(source: PhotographedMap, views: pd.DataFrame, parts: Sequence[WeakPart]) -> pd.DataFrame:
    """A row for each photograph: where it is, how often it was left out and localized, and all of the one time that it
    was left out with few others; empty where it was not among those looked at."""
    table = pd.DataFrame({"photograph": source.names})
    table[["x", "y", "z"]] = source.own_centers
    axes = source.poses[:, 2, :3] @ source.from_model.rotation  # where it looks, in the model's own frame
    table[["look_x", "look_y", "look_z"]] = axes
    times = views.groupby("row")["good"].agg(["size", "sum"]).reindex(range(len(table)), fill_value=0)
    table["times_left_out"] = times["size"].astype(int)
    table["times_localized"] = times["sum"].astype(int)
    once = views[views["is_part"]].set_index("row").reindex(range(len(table)))
    known = once["good"].notna()
    table["block"] = once["block"].astype("Int64")
    table["localized"] = once["good"].map({True: 1, False: 0}).where(known).astype("Int64")
    table["score"] = once["score"]
    table["in_range"] = once["in_range"].map({True: 1, False: 0}).where(known).astype("Int64")
    table["error"] = once["error_m"] / source.from_model.scale
    table["error_deg"] = once["error_deg"]
    table["limit"] = source.limit_m / source.from_model.scale
    for name in ("n_visible", "n_matches", "n_inliers", "n_observed", "n_kept"):
        table[name] = once[name].astype("Int64")
    table["expected_inliers"] = once["expected_inliers"]
    table["part"] = 0
    for part in parts:
        table.loc[part.rows, "part"] = part.number
    return table


def _blocks(source: PhotographedMap, left_out: Sequence[LeftOut], views: pd.DataFrame) -> pd.DataFrame:
    """A row for each block: how many photographs and landmarks, what was predicted, and what came out."""
    rows = []
    for one in left_out:
        of_block = views[views["block"] == one.block.number]
        center = np.median(source.own_centers[one.block.left_out], axis=0)
        row: dict[str, Any] = {"block": one.block.number, "kind": "part" if one.block.is_part else "grown"}
        row |= {
            "left_out": len(one.block.left_out),
            "looked_at": len(of_block),
            "localized": int(of_block["good"].sum()),
        }
        row |= {"share_localized": float(of_block["good"].mean()), "mean_score": float(of_block["score"].mean())}
        row |= {"landmarks": len(one.landmarks), "median_kept": float(of_block["n_kept"].median())}
        row |= {"median_inliers": float(of_block["n_inliers"].median())}
        row |= {"median_expected_inliers": float(of_block["expected_inliers"].median())}
        row |= dict(zip(("x", "y", "z"), center.tolist(), strict=True))
        row |= {"first": source.names[one.block.left_out[0]], "last": source.names[one.block.left_out[-1]]}
        rows.append(row)
    return pd.DataFrame(rows)


def _times(auc: dict[str, float | None]) -> str:
    if auc["value"] is None:
        return "an unknown number of times"
    interval = (
        "" if auc["low"] is None or auc["high"] is None else f" [{100 * auc['low']:.0f}, {100 * auc['high']:.0f}]"
    )
    return f"{100 * auc['value']:.0f} times in 100{interval}"


def _told(measured: dict[str, float | None], digits: int) -> str:
    if measured["value"] is None:
        return "unknown"
    text = f"{measured['value']:.{digits}f}"
    if measured["low"] is not None:
        text += f" [{measured['low']:.{digits}f}, {measured['high']:.{digits}f}]"
    return text
