"""The paper's tables hold its numbers and ours, and LaTeX can read them."""

import re

import numpy as np
import pytest

from synthetic_scores import KEYS, make_scores
from wheretolook_paper.evaluation.paper_tables import PAPER, paper_tables, write_paper_tables

PRINTED = {
    ("vs_others", "random"): (54.7, 60.9, 60.9, 61.1),
    ("vs_others", "FIF mineig exact"): (60.1, 67.7, 69.0, 69.6),
    ("vs_others", "FIF det app"): (60.7, 67.5, 69.1, 69.4),
    ("vs_others", "FIF trace appr worst"): (17.8, 23.3, 23.3, 23.3),
    ("vs_others", "reprojections with bins"): (68.7, 71.7, 71.7, 71.9),
    ("vs_others", "proposed"): (72.9, 80.4, 81.2, 81.7),
    ("input_variants", "ours (pts 2d)"): (70.2, 75.7, 76.2, 76.2),
    ("input_variants", "ours (pts 2d + z)"): (74.6, 80.3, 80.4, 80.6),
    ("input_variants", "ours (pts 2d + pts 3d)"): (72.9, 80.4, 81.2, 81.7),
}
HERE = {
    "FIF mineig exact": "Fisher, min. eigenvalue, exact",
    "FIF mineig app": "Fisher, min. eigenvalue, quadratic",
    "FIF det GP app": "Fisher, log det, GP",
    "FIF trace appr worst": "probe: worst trace",
    "FIF trace appr zero deriv labels": "probe: stationary trace",
    "proposed": "MLP, 2d + 3d",
}


@pytest.fixture(scope="module")
def scores():
    return make_scores()


def test_the_papers_numbers_are_those_printed(scores):
    tables = {name: table.set_index("paper_row") for name, table in paper_tables(scores).items()}
    assert {name: len(table) for name, table in tables.items()} == {"vs_others": 14, "input_variants": 3}
    for (name, row), numbers in PRINTED.items():
        np.testing.assert_array_equal(tables[name].loc[row, [f"paper_{key}" for key in KEYS]].astype(float), numbers)
    blank = tables["vs_others"].loc[["FIF trace GP app", "FIF trace exact"], [f"paper_{key}" for key in KEYS]]
    assert blank.isna().all(axis=None)
    assert tables["vs_others"].notna().all(axis=1).sum() == 12


def test_rows_hold_the_scores_of_their_methods(scores):
    tables = paper_tables(scores)
    names = dict(zip(tables["vs_others"]["paper_row"], tables["vs_others"]["method"], strict=True))
    assert {row: names[row] for row in HERE} == HERE
    pooled = scores[(scores["scene"] == "all") & (scores["top_n"] == 1)].set_index("method")
    for name, paper in PAPER.items():
        for one, (_, line) in zip(paper, tables[name].iterrows(), strict=True):
            row = pooled.loc[one.method]
            for key in KEYS:
                assert line[f"score_{key}"] == pytest.approx(100 * row[f"normalized_{key}"])
                assert line[f"score_low_{key}"] == pytest.approx(100 * row[f"normalized_low_{key}"])
                assert line[f"score_high_{key}"] == pytest.approx(100 * row[f"normalized_high_{key}"])
                assert line[f"released_{key}"] == pytest.approx(100 * row[f"raw_{key}"] / 0.527)


@pytest.mark.parametrize("name", PAPER)
def test_latex_rows_have_every_column(scores, tmp_path, name):
    write_paper_tables(scores, tmp_path)
    text = (tmp_path / f"table_{name}.tex").read_text()
    body = text.split(r"\toprule")[1].split(r"\bottomrule")[0]
    rows = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert len(rows) == 2 + len(PAPER[name])
    for row in rows:
        spanned = sum(int(number) - 1 for number in re.findall(r"\\multicolumn\{(\d+)\}", row))
        assert row.count("&") + 1 + spanned == 13
        assert row.count("{") == row.count("}") and row.count("$") % 2 == 0
    line = next(row for row in rows if row.startswith("MLP, 2d + 3d"))
    assert line.split(" & ")[3] == "72.9"
