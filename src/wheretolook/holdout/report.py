"""Results of a check: its numbers, the parts of the map that relocalize badly, and a figure."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from wheretolook.dataset.config import ACCURACY, Accuracy
from wheretolook.evaluation.statistics import reliability
from wheretolook.figures.floor_plan import BLUE, INK, RC, VERMILION, label_plan, new_figure
from wheretolook.holdout.holdout import VIEWS, HoldoutResult, choose_blocks, hold_out_blocks, judged
from wheretolook.holdout.metrics import measure
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.holdout.scores import VISIBLE, Scoring, check_place, score_views
from wheretolook.mapping.colmap_model import observation_matrix
from wheretolook.mapping.georeference import DEPTH_M
from wheretolook.scorers.registry import is_probability
from wheretolook.training.trained_network import MapCalibration
from wheretolook.utils.files import write_json, write_text
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import OcclusionModel


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
    alike = shared >= 0.2 * np.minimum(counts[:, None], counts)  # of the landmarks of the photograph that has fewer
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
            "turned_upright": self.source.frame.is_turned,
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
        if numbers["share_in_range"] < 0.5:
            return "do not use these scores: most views are outside the range of the training views"
        if auc["value"] is None:
            return "whether to trust the order of the scores is unknown"
        if auc["value"] < 0.7:
            return "do not use these scores: they hardly order the views of this map"
        errors = numbers["errors_at_right_place"]
        # of rendered scenes about 0.03, and errors are within a factor of 1.7 of the expected ones
        wrong = numbers["ece"] and numbers["ece"]["value"] > max(0.08, numbers["ece_if_calibrated"])
        if wrong or (errors and not 0.6 <= errors["m"]["ratio"]["value"] <= 1.7):
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
                f"predicted, {100 * numbers['share_localized']:.0f} % localize; exact probabilities of as many views have "
                f"up to {numbers['ece_if_calibrated']:.3f}"
            )
        if errors := numbers["errors_at_right_place"]:
            lines.append(self._errors_line(errors))
        if ratios := numbers["inliers_found_over_expected"]:
            good, every = (_with_interval(ratios[name], 2) for name in ("localized", "all"))
            lines.append(f"inliers over expected: {good} of views that localize, {every} of all")
        if of_map := numbers.get("map"):
            lines.append(MapCalibration(**of_map).describe())
        if source.fov_deg is not None:
            lines.append(f"views of {source.fov_deg:g} degrees, {source.n_crops} of each photograph")
        if numbers["share_in_range"] < 1:
            lines.append(f"{100 * (1 - numbers['share_in_range']):.0f} % of the views are outside the training range")
        if source.frame.gravity == "levelled" and source.frame.is_turned:
            lines.append("the model was turned upright; --up states another direction, --up z keeps the model's")
        if not source.is_metric:
            lines.extend(source.frame.doubts[:1])
        if not self.parts:
            return [*lines, "no part of the map fails without its neighbours"]
        lines.append(f"photograph again ({len(self.parts)} parts relocalize badly, {source.frame.unit}):")
        printed = self.parts[:5]  # all are in the files
        lines += [f"  {part.number}. {part.describe(source.names, source.frame.unit)}" for part in printed]
        if self.parts != printed:
            lines.append(f"  and {len(self.parts) - len(printed)} more: column part of check.csv")
        return lines

    def _errors_line(self, errors: Mapping[str, Any]) -> str:
        """State observed and expected errors: in centimetres, or as a share of the median depth."""
        of_position = errors["m"]
        unit, factor = ("cm", 100) if self.source.is_metric else ("% of depth", 100 / DEPTH_M)
        medians, highest = (
            f"{factor * of_position[f'observed_{q}']:.2g} {unit}, {factor * of_position[f'expected_{q}']:.2g} expected"
            for q in ("50%", "90%")
        )
        return (
            f"position errors of the {of_position['n']} views at the right place: median {medians}; 90 % below {highest}; "
            f"observed over expected {_with_interval(of_position['ratio'], 2)}, of orientations "
            f"{_with_interval(errors['deg']['ratio'], 2)}"
        )


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
    if source.photographs and (of_map := source.map.computed.get("calibration")):
        numbers["map"] = asdict(of_map)
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


def check_figure(report: CheckReport) -> Figure:
    """Draw the map from above with all photographs, and predictions against results for views and for blocks.

    The colour of a photograph is its result in the block of the partition; numbers are those of parts that relocalize
    badly.
    """
    with context(RC):
        figure = new_figure(12.5, 6.6)
        grid = figure.add_gridspec(2, 3, width_ratios=(2.1, 1, 1))
        _draw_map(figure.add_subplot(grid[:, 0]), report)
        _draw_calibration(figure.add_subplot(grid[0, 1]), report)
        _draw_inliers(figure.add_subplot(grid[0, 2]), report)
        _draw_blocks(figure.add_subplot(grid[1, 1:]), report)
        figure.suptitle(textwrap.fill(f"{report.source.name}: {report.sentence()}", 120), fontsize=11)
        return figure


def _draw_map(axes: Axes, report: CheckReport) -> None:
    source = report.source
    points = (source.arrays.points - source.from_model.translation) / source.from_model.scale
    centers = source.own_centers @ source.from_model.rotation.T
    looks = source.poses[:, 2, :3]
    ends = np.concatenate([np.percentile(points[:, :2], (2, 98), axis=0), centers[:, :2]])
    low = ends.min(0)
    high = ends.max(0)
    margin = 0.1 * (high - low).max()  # the numbers of weak parts are up to 0.08 out
    step = max(1, len(points) // 20_000)
    axes.scatter(points[::step, 0], points[::step, 1], s=1, color="#c4c4c4", linewidths=0, rasterized=True, zorder=1)
    length = 0.035 * float((high - low).max())
    localized = report.photographs["localized"].to_numpy(dtype=float, na_value=np.nan)
    kinds = [(np.isnan(localized), "#999999", "not tested"), (localized == 1, BLUE, "localized")]
    kinds.append((localized == 0, VERMILION, "not localized"))
    for mask, color, label in kinds:
        if not mask.any():
            continue
        at = centers[mask, :2]
        along = looks[mask, :2] * length
        axes.quiver(
            *at.T, *along.T, color=color, angles="xy", scale_units="xy", scale=1, width=0.0025, headwidth=3, zorder=3
        )
        axes.scatter(at[:, 0], at[:, 1], s=14, color=color, label=f"{label} ({mask.sum()})", zorder=4, linewidths=0)
    for part in report.parts:
        middle = np.median(centers[part.rows, :2], axis=0)
        out = np.median(looks[part.rows, :2], axis=0) * -2.2 * length
        style: dict[str, Any] = {"arrowstyle": "-", "color": INK, "linewidth": 0.8}
        box: dict[str, Any] = {"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": VERMILION}
        axes.annotate(
            str(part.number), tuple(middle), tuple(middle + out), fontsize=9, ha="center", va="center", zorder=5,
            arrowprops=style, bbox=box,
        )  # fmt: skip
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    label_plan(axes, source.frame, low, (high - low).max())
    axes.set_title("from above; photographs held out with their neighbours", pad=24)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, handletextpad=0.1, borderaxespad=0.2)


def _draw_calibration(axes: Axes, report: CheckReport) -> None:
    numbers = report.numbers
    views = report.views
    if numbers["ece"] is None:
        good = views["good"].to_numpy(dtype=bool)
        for mask, color, label in ((good, BLUE, "localized"), (~good, VERMILION, "not localized")):
            axes.hist(views["score"][mask], bins=20, color=color, alpha=0.6, label=label)
        axes.set(xlabel=f"score of {report.method}", ylabel="views", title="scores")
        axes.legend()
        return
    # fewer than of the calibration error, as photographs are few
    curve = reliability(views["score"].to_numpy(), views["good"].to_numpy(dtype=bool), 10)
    known = curve[curve["n"] > 0]
    axes.plot([0, 1], [0, 1], color=INK, linewidth=1, linestyle="--")
    axes.plot(known["mean_predicted"], known["share_good"], color=BLUE, zorder=3)
    sizes = 12 + 140 * known["n"] / known["n"].max()
    axes.scatter(known["mean_predicted"], known["share_good"], s=sizes, color=BLUE, zorder=3, clip_on=False)
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="predicted probability", ylabel="share that localizes")
    axes.set_title(f"calibration error {numbers['ece']['value']:.2f}")


def _draw_inliers(axes: Axes, report: CheckReport) -> None:
    views = report.views
    expected = views["expected_inliers"].to_numpy(np.float64)
    n_inliers = views["n_inliers"].to_numpy(np.float64)
    label = "expected inliers"
    if not np.isfinite(expected).all():
        expected = views["n_visible"].to_numpy(np.float64)
        label = "landmarks in view"
    good = views["good"].to_numpy(dtype=bool)
    most = 1.3 * max(float(expected.max(initial=1)), float(n_inliers.max(initial=1)), 10.0)
    axes.plot([1, most], [1, most], color=INK, linewidth=1, linestyle="--")
    for mask, color in ((good, BLUE), (~good, VERMILION)):
        axes.scatter(
            np.maximum(expected[mask], 0.5), np.maximum(n_inliers[mask], 0.5), s=9, color=color, alpha=0.6, linewidths=0
        )
    axes.set(xscale="log", yscale="log", xlabel=label, ylabel="inliers", title="expected and actual inliers")
    axes.set(xlim=(0.4, most), ylim=(0.4, most))


def _draw_blocks(axes: Axes, report: CheckReport) -> None:
    blocks = report.blocks
    at = np.arange(len(blocks))
    axes.bar(at, blocks["share_localized"], color=BLUE, alpha=0.45, width=0.7, label="share that localizes")
    if report.numbers["ece"] is not None:
        axes.plot(at, blocks["mean_score"], color=INK, marker="o", linestyle="", markersize=5, label="predicted")
    axes.set_xticks(at, [f"{row.left_out}" for row in blocks.itertuples()])
    axes.set(ylim=(0, 1.02), ylabel="share of the views")
    first = int((blocks["kind"] == "part").sum())
    axes.set_xlabel(
        f"photographs held out ({first} blocks that partition all, {len(blocks) - first} grown ones)\n"
        "in the bars: landmarks of a photograph that the rest still has"
    )
    if 0 < first < len(blocks):
        axes.axvline(first - 0.5, color=INK, linewidth=0.8, linestyle=":")
    for place, row in enumerate(blocks.itertuples()):
        axes.annotate(f"{row.median_kept:.0f}", (place, 0.02), ha="center", fontsize=8)
    axes.set_title("blocks", loc="left", pad=22)
    axes.grid(axis="x", visible=False)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.08), ncols=2, borderaxespad=0)
