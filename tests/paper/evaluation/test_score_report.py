"""Score tables as Markdown."""

import re

import numpy as np
import pandas as pd
import pytest

from synthetic_scores import KEYS, make_scores
from wheretolook.evaluation.results import main_rows
from wheretolook_paper.evaluation.score_report import comparisons_markdown, score_markdown

FINEST = KEYS[0]


@pytest.fixture(scope="module")
def scores():
    return make_scores()


def table_below(report, heading):
    """The cells, by row and column, of the first table below a heading that starts so."""
    body = report.split(f"## {heading}", 1)[1]
    lines = re.search(r"(^\|.*\|$\n?)+", body, re.MULTILINE)
    assert lines is not None
    header, _, *rows = ([cell.strip() for cell in line[1:-1].split("|")] for line in lines[0].strip().splitlines())
    return {row[0]: dict(zip(header[1:], row[1:], strict=True)) for row in rows}


def one_row(scores, method, n=1, scene="all"):
    chosen = scores["method"] == method
    return scores[chosen & (scores["top_n"] == n) & (scores["scene"] == scene)].iloc[0]


def percent(value):
    return f"{100 * value:.1f}"


def test_main_table(scores):
    table = table_below(score_markdown(scores), "Best viewpoint of each location (100 in all)")
    row = one_row(scores, "mlp-2d")
    cells = table["MLP, 2d"]
    for key, name in zip(KEYS, ("5 cm, 0.4°", "25 cm, 2°", "0.5 m, 5°", "5 m, 10°"), strict=True):
        names = ("normalized", "normalized_low", "normalized_high", "raw")
        share, low, high, raw = (percent(row[f"{name}_{key}"]) for name in names)
        assert cells[name] == f"{share} [{low}, {high}] ({raw})"
    assert cells["regret"].startswith(percent(row[f"regret_{FINEST}"]))
    assert cells["AP"] == f"{row['average_precision']:.3f}"
    assert table["MLP, 2d + 3d"]["difference"] == "reference"


def test_unknown_numbers_are_left_out(scores):
    empty = scores.copy()
    empty.loc[empty["scene"] == "b", [name for name in empty.columns if name.endswith(KEYS)]] = np.nan
    report = score_markdown(empty)
    assert {cells["b"] for cells in table_below(report, "By scene").values()} == {"–"}
    assert "nan" not in report


def test_occlusion_models_and_candidates_are_compared(scores):
    other = make_scores(seed=1).assign(occlusion="none")
    fewer = make_scores(seed=2).assign(candidates="best 100")
    fewer = fewer[fewer["method"] != "mlp-2d"]
    everything = pd.concat([scores, fewer, other])
    pd.testing.assert_frame_equal(main_rows(everything), scores)
    photographs = make_scores(seed=3).assign(candidates="photographs")
    assert "## Photographs" in score_markdown(pd.concat([scores, photographs]))
    report = comparisons_markdown(everything)
    for heading, value, table in (("By occlusion", "none", other), ("By set of candidates", "best 100", fewer)):
        row = one_row(table, "random")
        cell = table_below(report, heading)["random"][value]
        assert cell.startswith(f"{row['average_precision']:.3f}, {percent(row[f'normalized_{FINEST}'])} [")
