"""The paper's two tables with this project's numbers next to the printed ones: as CSV, LaTeX, Markdown, for notebooks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from wheretolook.dataset.config import ALL, THRESHOLDS, threshold_key, threshold_label
from wheretolook.evaluation.results import RELEASED_DIVISOR, main_rows, methods_of
from wheretolook.tracking import TrackingConfig, newest_artifact
from wheretolook.utils.files import write_text
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.evaluation.score_report import comparisons_markdown
from wheretolook_paper.styles import method_style

if TYPE_CHECKING:
    from pandas.io.formats.style import Styler


KEYS = tuple(map(threshold_key, THRESHOLDS))  # the paper's thresholds

NOTE = (
    "The paper's numbers were measured on other scenes (12 Habitat-Matterport meshes) and divided by one constant, "
    f"{RELEASED_DIVISOR}, at all thresholds: they can be compared with ours in kind, not in size."
)
"""Note below every table."""


@dataclass(frozen=True)
class _PaperRow:
    """A printed row: the paper's name, the method here, and its numbers in %, none where the paper prints a dash."""

    name: str
    method: str
    printed: tuple[float, ...] = ()


PROPOSED = "mlp-2d+3d"

PAPER = {
    "vs_others": (
        _PaperRow("random", "random", (54.7, 60.9, 60.9, 61.1)),
        _PaperRow("FIF mineig exact", "fisher-mineig-exact", (60.1, 67.7, 69.0, 69.6)),
        _PaperRow("FIF mineig app", "fisher-mineig-quadratic", (57.3, 64.7, 66.2, 66.4)),
        _PaperRow("FIF mineig GP app", "fisher-mineig-gp", (59.8, 65.4, 65.7, 66.8)),
        _PaperRow("FIF det exact", "fisher-logdet-exact", (59.2, 65.4, 66.2, 66.2)),
        _PaperRow("FIF det app", "fisher-logdet-quadratic", (60.7, 67.5, 69.1, 69.4)),
        _PaperRow("FIF det GP app", "fisher-logdet-gp", (58.8, 67.0, 67.1, 67.2)),
        _PaperRow("FIF trace app", "fisher-trace-quadratic", (55.4, 61.1, 61.8, 62.0)),
        _PaperRow("FIF trace GP app", "fisher-trace-gp"),
        _PaperRow("FIF trace appr worst", "fisher-worst-trace", (17.8, 23.3, 23.3, 23.3)),
        _PaperRow("FIF trace appr zero deriv labels", "fisher-stationary-trace", (12.5, 16.7, 17.3, 17.3)),
        _PaperRow("FIF trace exact", "fisher-trace-exact"),
        _PaperRow("reprojections with bins", "bins", (68.7, 71.7, 71.7, 71.9)),
        _PaperRow("proposed", PROPOSED, (72.9, 80.4, 81.2, 81.7)),
    ),
    "input_variants": (
        _PaperRow("ours (pts 2d)", "mlp-2d", (70.2, 75.7, 76.2, 76.2)),
        _PaperRow("ours (pts 2d + z)", "mlp-2d+z", (74.6, 80.3, 80.4, 80.6)),
        _PaperRow("ours (pts 2d + pts 3d)", PROPOSED, (72.9, 80.4, 81.2, 81.7)),
    ),
}
"""The paper's tables 2 and 3, as printed (Di Giammarino et al., ECCV 2024)."""

_TITLES = {
    "vs_others": "Localization score of the best view of each location by all methods (probes are none: they look "
    "along the direction that a Fisher field says is worst)",
    "input_variants": "Localization score of the best view of each location by the network's inputs",
}

_OURS = ("score", "score_low", "score_high", "released")
"""Columns of our numbers, before the threshold's name, and those of the score table they come from."""
_SOURCES = ("normalized", "normalized_low", "normalized_high", "released")


def paper_tables(scores: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the paper's tables, "vs_others" and "input_variants", with this project's numbers next to the printed ones.

    Uses the rows of a score table (`wheretolook.evaluation.results.score_table`) over all scenes with N = 1, those
    of the first occlusion model and the first set of candidates.

    A row for each of the paper's in its order: `paper_row` (its name there), `method` (its name here) and for each
    threshold, in %: score_* (share divided by the oracle's) with score_low_* and score_high_* (95 % bootstrap
    interval), released_* (share divided by 0.527) and paper_* (printed); then `note`. NaN where either has no number.
    Where the network with the input "2d+3d" is missing, the first of the paper's networks stands in for the row
    "proposed", and `method` says so.
    """
    rows = main_rows(scores)
    rows = rows[(rows["scene"] == ALL) & (rows["top_n"] == 1)]
    paper_networks = [method for method in methods_of(rows) if method.startswith("mlp-")]
    ours = {row["method"]: row for row in rows.to_dict("records")}
    tables = {}
    for name, paper in PAPER.items():
        lines = []
        for one in paper:
            method = one.method
            label = method_style(one.method).label
            if one.name == "proposed" and paper_networks and method not in paper_networks:
                method = paper_networks[0]
                label = f"{method_style(method).label} (in place of {PROPOSED.partition('-')[2]})"
            line: dict[str, object] = {"paper_row": one.name, "method": label}
            for index, key in enumerate(KEYS):
                for column, source in zip(_OURS, _SOURCES, strict=True):
                    line[f"{column}_{key}"] = 100 * ours.get(method, {}).get(f"{source}_{key}", float("nan"))
                line[f"paper_{key}"] = one.printed[index] if one.printed else float("nan")
            lines.append({**line, "note": NOTE})
        tables[name] = pd.DataFrame(lines)
    return tables


def write_paper_tables(scores: pd.DataFrame, folder: Path) -> list[Path]:
    """Write `table_vs_others` and `table_input_variants` (`paper_tables`) into a folder as .csv, .tex and .md files.

    Also writes `comparisons.md` (`comparisons_markdown`).
    """
    paths = [folder / "comparisons.md"]
    write_text(paths[0], comparisons_markdown(scores))
    for name, table in paper_tables(scores).items():
        texts = {
            "csv": table.to_csv(index=False, float_format="%.2f"),
            "tex": paper_latex(table, _TITLES[name], f"tab:{name.replace('_', '-')}"),
            "md": paper_markdown(table, _TITLES[name]),
        }
        for ending, text in texts.items():
            paths.append(folder / f"table_{name}.{ending}")
            write_text(paths[-1], text)
    return paths


_ABOUT = (
    "In % of the chosen views that localize within both limits. Ours: divided by the oracle's share, with 95 % "
    f"bootstrap interval over locations; /{RELEASED_DIVISOR}: divided by that constant, as the paper's numbers are."
)


def paper_markdown(table: pd.DataFrame, title: str) -> str:
    """Format a table of `paper_tables` in Markdown, two thresholds side by side."""
    parts = [f"# {title}", _ABOUT, NOTE]
    for begin in range(0, len(KEYS), 2):
        keys = KEYS[begin : begin + 2]
        header = ["paper's row", "here"]
        for key in keys:
            header += [f"{threshold_label(key)}: ours", f"/{RELEASED_DIVISOR}", "paper"]
        parts.append(markdown_table(header, _cells(table, keys, _with_brackets, "–")))
    return "\n\n".join(parts) + "\n"


def paper_latex(table: pd.DataFrame, title: str, label: str) -> str:
    r"""Format a table of `paper_tables` in LaTeX with booktabs: a float over the full width, intervals as indices.

    The title begins the caption, the label is for `\ref`.
    """
    groups = " & ".join(rf"\multicolumn{{3}}{{c}}{{{_escaped(threshold_label(key))}}}" for key in KEYS)
    rules = " ".join(rf"\cmidrule(lr){{{2 + 3 * index}-{4 + 3 * index}}}" for index in range(len(KEYS)))
    kinds = " & ".join([f"ours & /{RELEASED_DIVISOR} & paper"] * len(KEYS))
    rows = [" & ".join([_escaped(line[1]), *line[2:]]) + r" \\" for line in _cells(table, KEYS, _with_indices, "--")]
    caption = _escaped(f"{title}. {_ABOUT} {NOTE}")
    lines = "\n".join(rows)
    return rf"""% {NOTE}
% Needs \usepackage{{booktabs}}.
\begin{{table*}}
\centering
\caption{{{caption}}}
\label{{{label}}}
\footnotesize
\setlength{{\tabcolsep}}{{2pt}}
\renewcommand{{\arraystretch}}{{1.4}}
\smallskip
\begin{{tabular}}{{l{"ccc" * len(KEYS)}}}
\toprule
& {groups} \\
{rules}
method & {kinds} \\
\midrule
{lines}
\bottomrule
\end{{tabular}}
\end{{table*}}
"""


def _cells(
    table: pd.DataFrame, keys: Sequence[str], with_interval: Callable[[float, float, float], str], unknown: str
) -> list[list[str]]:
    """Return the cells of each row: the paper's name, the name here, and three numbers for each threshold."""
    lines = []
    for row in table.to_dict("records"):
        line = [row["paper_row"], row["method"]]
        for key in keys:
            score, low, high, released = (row[f"{name}_{key}"] for name in _OURS)
            line.append(unknown if pd.isna(score) else with_interval(score, low, high))
            line += [unknown if pd.isna(value) else f"{value:.1f}" for value in (released, row[f"paper_{key}"])]
        lines.append(line)
    return lines


def _with_brackets(value: float, low: float, high: float) -> str:
    return f"{value:.1f}" + (f" [{low:.1f}, {high:.1f}]" if low < high else "")


def _with_indices(value: float, low: float, high: float) -> str:
    return f"${value:.1f}" + (f"_{{{low:.1f}}}^{{{high:.1f}}}" if low < high else "") + "$"


_SPECIAL = {"%": r"\%", "&": r"\&", "#": r"\#", "_": r"\_", "°": r"$^\circ$", "±": r"$\pm$"}


def _escaped(text: str) -> str:
    """Escape a text for LaTeX."""
    return "".join(_SPECIAL.get(letter, letter) for letter in text)


DIVIDED = f"/{RELEASED_DIVISOR}"  # name of the column of shares divided by the released code's constant


def latest_paper_table(tracking: TrackingConfig, name: str, dataset: str = "") -> pd.DataFrame:
    """Read the paper's table "vs_others" or "input_variants" from the newest evaluation of a dataset, or of any ("").

    Raises MissingRunError if there is none.
    """
    return pd.read_csv(newest_artifact(tracking, "evaluate", f"table_{name}.csv", dataset))


def paper_cells(table: pd.DataFrame) -> pd.DataFrame:
    """Format the cells of a table of `paper_tables`.

    A row for each of the paper's methods, by its names there and here; for each threshold the columns "ours" (% of the
    oracle's share), "95 %" (its interval), "/0.527" and "paper", with a dash for missing numbers.
    """
    columns = {}
    for key in KEYS:
        low = table[f"score_low_{key}"]
        high = table[f"score_high_{key}"]
        interval = low.map(_cell) + " – " + high.map(_cell)
        columns[threshold_label(key), "ours"] = table[f"score_{key}"].map(_cell)
        columns[threshold_label(key), "95 %"] = interval.where(low < high, "")
        columns[threshold_label(key), DIVIDED] = table[f"released_{key}"].map(_cell)
        columns[threshold_label(key), "paper"] = table[f"paper_{key}"].map(_cell)
    cells = pd.DataFrame(columns)
    cells.index = pd.MultiIndex.from_frame(table[["paper_row", "method"]], names=["paper", "here"])
    return cells


def paper_styler(table: pd.DataFrame) -> Styler:
    """Style `paper_cells` for a notebook: best numbers in bold, intervals and "/0.527" in grey."""
    cells = paper_cells(table)
    bold = pd.DataFrame("", index=cells.index, columns=cells.columns)
    for key in KEYS:
        for source, name in ((f"score_{key}", "ours"), (f"paper_{key}", "paper")):
            values = table[source].to_numpy()
            bold.loc[values == table[source].max(), (threshold_label(key), name)] = "font-weight: bold"
        bold[threshold_label(key), "95 %"] = bold[threshold_label(key), DIVIDED] = "color: #777777; font-size: 85%"
    layout: list[Any] = [
        {"selector": "td", "props": "text-align: right; white-space: nowrap; padding: 2px 6px"},
        {"selector": "th", "props": "text-align: left; white-space: nowrap; font-weight: normal; padding: 2px 6px"},
        {"selector": "th.col_heading", "props": "text-align: center; font-weight: bold"},
    ]
    return cells.style.apply(lambda _: bold, axis=None).set_table_styles(layout)


def _cell(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.1f}"
