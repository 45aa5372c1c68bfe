"""The score table as Markdown says what the table says, and no more."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest

from synthetic_scores import EVERY_METHOD, KEYS, make_scores, older
from wheretolook.evaluation.report import best_in_words, score_markdown
from wheretolook.evaluation.score_table import main_rows, reference_of
from wheretolook.scorers.styles import method_style

FINEST = KEYS[0]


@pytest.fixture(scope="module")
def scores() -> pd.DataFrame:
    return make_scores()


@pytest.fixture(scope="module")
def report(scores: pd.DataFrame) -> str:
    return score_markdown(scores, "Scores of something")


def table_below(report: str, heading: str) -> dict[str, dict[str, str]]:
    """The first table below a heading that starts so: its cells by row and column."""
    body = report.split(f"\n## {heading}", 1)[1]
    lines = re.search(r"(^\|.*\|$\n?)+", body, re.MULTILINE)
    assert lines is not None
    header, _, *rows = ([cell.strip() for cell in line[1:-1].split("|")] for line in lines[0].strip().splitlines())
    return {row[0]: dict(zip(header[1:], row[1:], strict=True)) for row in rows}


def headings(report: str) -> list[str]:
    return re.findall(r"^## (.*)$", report, re.MULTILINE)


def one_row(scores: pd.DataFrame, method: str, n: int = 1, scene: str = "all") -> pd.Series:
    chosen = scores["method"] == method
    return scores[chosen & (scores["top_n"] == n) & (scores["scene"] == scene)].iloc[0]


def percent(value: float) -> str:
    return f"{100 * value:.1f}"


def test_the_headline_table_holds_all_that_is_known(scores: pd.DataFrame, report: str) -> None:
    assert report.startswith("# Scores of something\n\nScenes: a, b; 100 locations.\n")
    table = table_below(report, "Best viewpoint of each location (100 in all)")
    assert [*table["random"]] == [
        "5 cm, 0.4°",
        "25 cm, 2°",
        "0.5 m, 5°",
        "5 m, 10°",
        "regret",
        "difference",
        "AP",
        "AUC",
    ]
    for method in ("random", "fisher-logdet-gp", "mlp-2d"):
        row = one_row(scores, method)
        cells = table[method_style(method).label]
        for key, name in zip(KEYS, ("5 cm, 0.4°", "25 cm, 2°", "0.5 m, 5°", "5 m, 10°"), strict=True):
            share, low, high, raw = (
                percent(row[f"{name}_{key}"]) for name in ("normalized", "normalized_low", "normalized_high", "raw")
            )
            assert cells[name] == f"{share} [{low}, {high}] ({raw})"
        regret, low, high = (percent(row[f"{name}_{FINEST}"]) for name in ("regret", "regret_low", "regret_high"))
        assert cells["regret"] == f"{regret} [{low}, {high}]"
        assert cells["AP"] == f"{row['average_precision']:.3f}"
        assert cells["AUC"] == f"{row['roc_auc']:.3f}"
        difference = re.fullmatch(r"([+-][\d.]+) \[([+-][\d.]+), ([+-][\d.]+)\], p 0\.040", cells["difference"])
        assert difference is not None
        expected = [100 * row[f"{name}_{FINEST}"] for name in ("difference", "difference_low", "difference_high")]
        np.testing.assert_allclose([float(number) for number in difference.groups()], expected, atol=0.051)
    assert table["MLP, 2d + 3d"]["difference"] == "reference"
    assert "less that of MLP, 2d + 3d" in report
    assert table["oracle"]["5 cm, 0.4°"] == "100.0 [98.0, 100.0] (90.0)"


def test_further_tables(scores: pd.DataFrame, report: str) -> None:
    assert headings(report) == [
        "Best viewpoint of each location (100 in all)", "Best 5 viewpoints of each location (500 in all)",
        "Best 10 viewpoints of each location (1,000 in all)", "At least one good",
        "By scene: best viewpoint of each location, within 5 cm, 0.4°", "Divided by 0.527", "Calibration", "Probes",
    ]  # fmt: skip
    five = table_below(report, "Best 5 viewpoints")["MLP, 2d"]
    row = one_row(scores, "mlp-2d", 5)
    assert five["25 cm, 2°"] == f"{percent(row[f'normalized_{KEYS[1]}'])} ({percent(row[f'raw_{KEYS[1]}'])})"
    some = table_below(report, "At least one good")["reprojections with bins"]
    for n in (1, 5, 10):
        row = one_row(scores, "bins", n=n)
        share, low, high = (percent(row[f"any_{end}{FINEST}"]) for end in ("", "low_", "high_"))
        assert some[f"best {n}"] == f"{share} [{low}, {high}]"
    scene = table_below(report, "By scene")["forward"]
    assert [*scene] == ["a", "b"]
    row = one_row(scores, "forward", scene="b")
    assert scene["b"].startswith(percent(row[f"normalized_{FINEST}"]))
    assert scene["b"].endswith(f", {row[f'good_{FINEST}']:.0f} of 50")
    released = table_below(report, "Divided by 0.527")["random"]
    assert released["5 m, 10°"] == percent(one_row(scores, "random")[f"raw_{KEYS[3]}"] / 0.527)
    assert "- MLP, 2d + z: 0.071 → 0.023 with T = 1.38" in report
    assert "comparison with the paper's numbers only" in report


def test_probes_stand_apart(scores: pd.DataFrame, report: str) -> None:
    head, tail = report.split("\n## Probes")
    assert "probe" not in head
    table = table_below(report, "Probes")
    assert [*table] == ["probe: worst trace", "probe: stationary trace"]
    row = one_row(scores, "fisher-worst-trace")
    assert table["probe: worst trace"]["25 cm, 2°"].startswith(percent(row[f"normalized_{KEYS[1]}"]))
    assert "no methods" in tail
    assert "Probes" not in score_markdown(scores[~scores["method"].str.startswith("fisher-")])


def test_no_table_is_wide(report: str) -> None:
    scenes = tuple(f"scene-{number}" for number in range(20))
    many = score_markdown(make_scores(EVERY_METHOD[:4], None, scenes=scenes))
    for text in (report, many):
        assert max(line.count("|") - 1 for line in text.splitlines()) <= 9
    assert all(f"| {scene} " in many for scene in scenes)


def test_an_expected_number_has_a_decimal_place(scores: pd.DataFrame) -> None:
    changed = scores.copy()
    chosen = (changed["method"] == "random") & (changed["scene"] == "a")
    changed.loc[chosen, f"raw_{FINEST}"] = 0.455
    assert table_below(score_markdown(changed), "By scene")["random"]["a"].endswith(", 22.8 of 50")


def test_older_tables_have_what_they_have(scores: pd.DataFrame) -> None:
    old = older(scores).drop(columns="occlusion")
    report = score_markdown(old)
    table = table_below(report, "Best viewpoint of each location")
    assert [*table["random"]] == ["5 cm, 0.4°", "25 cm, 2°", "0.5 m, 5°", "5 m, 10°", "AP", "AUC"]
    assert headings(report) == [
        name for name in headings(score_markdown(scores)) if name not in ("Divided by 0.527", "Calibration")
    ]
    for word in ("regret", "difference", "p-value", "nan"):
        assert word not in report
    assert table == {
        name: {column: cell for column, cell in cells.items() if column not in ("regret", "difference")}
        for name, cells in table_below(score_markdown(scores), "Best viewpoint of each location").items()
    }


def test_without_a_reference_there_are_no_differences() -> None:
    scores = make_scores(EVERY_METHOD[:4], reference="")
    assert reference_of(scores) == ""
    report = score_markdown(scores)
    assert "difference" not in report
    assert "regret" in report


def test_the_reference_is_known_where_another_method_chooses_alike(scores: pd.DataFrame) -> None:
    assert reference_of(scores) == "mlp-2d+3d"
    assert reference_of(make_scores(reference="bins")) == "bins"
    equal = scores.copy()
    differences = [name for name in equal.columns if name.startswith("difference_")]
    equal.loc[equal["method"] == "random", differences] = 0.0
    assert reference_of(equal) == "mlp-2d+3d"


def test_occlusion_models_and_candidates_are_compared(scores: pd.DataFrame) -> None:
    other = make_scores(seed=1).assign(occlusion="none")
    fewer = make_scores(seed=2).assign(candidates="best 100")
    fewer = fewer[fewer["method"] != "mlp-2d"]
    everything = pd.concat([scores, fewer, other])  # indices repeat
    report = score_markdown(everything)
    pd.testing.assert_frame_equal(main_rows(everything), scores)
    assert table_below(report, "Best viewpoint") == table_below(score_markdown(scores), "Best viewpoint")
    occlusions = table_below(report, "By occlusion model")
    candidates = table_below(report, "By set of candidates")
    assert [*occlusions["random"]] == ["mesh", "none"]
    assert [*candidates["random"]] == ["all", "best 100"]
    for cell, table in (
        (occlusions["random"]["none"], other), (candidates["random"]["best 100"], fewer),
        (candidates["random"]["all"], scores),
    ):  # fmt: skip
        row = one_row(table, "random")
        assert cell.startswith(f"{row['average_precision']:.3f}, {percent(row[f'normalized_{FINEST}'])} [")
    assert candidates["MLP, 2d"]["best 100"] == "–"
    assert "probe: worst trace" not in candidates
    assert "the best 100 directions" in score_markdown(fewer)


def test_unknown_numbers_are_dashes(scores: pd.DataFrame) -> None:
    empty = scores.copy()
    inside = empty["scene"] == "b"
    numbers = [name for name in empty.columns if name.endswith(KEYS)]
    empty.loc[inside, numbers] = np.nan
    empty.loc[inside, ["n_locations", "n_views"]] = 0
    table = table_below(score_markdown(empty), "By scene")
    assert {cells["b"] for cells in table.values()} == {"–"}
    assert "nan" not in score_markdown(empty)


def told(reference: str = "", n: int = 1, **good: float) -> str:
    """What is said of methods that have so many good views of 50; ends of intervals are 0.06 off where they are told
    for one method, 0.03 where for a difference."""
    table = make_scores(("random", *good), reference or None, (n,), ("a",))
    table["reference"] = reference
    for name, value in {**good, "random": 20.5}.items():
        rows = table["method"] == name
        share = value / 50
        table.loc[rows, f"raw_{FINEST}"] = share
        table.loc[rows, [f"raw_low_{FINEST}", f"raw_high_{FINEST}"]] = share - 0.06, share + 0.06
        difference = share - good.get(reference, np.nan) / 50
        ends = [f"difference_low_{FINEST}", f"difference_high_{FINEST}"]
        table.loc[rows, ends] = difference - 0.03, difference + 0.03
    return best_in_words(table)


def test_who_chose_best_and_whether_that_is_chance() -> None:
    assert told(bins=36, visible=30, forward=35) == (
        "Reprojections with bins chose a view that localizes within 5 cm, 0.4° at 36 of 50 locations; forward at 35, "
        "random at 20.5, and the oracle, which knows, at 45. By 50 locations it cannot be told which of the first two "
        "is better: the 95 % intervals of their shares overlap, [66.0, 78.0] and [64.0, 76.0]."
    )
    assert told(bins=40, visible=30).endswith(
        "The first is better than the second by more than chance: the 95 % intervals of their shares do not overlap, "
        "[74.0, 86.0] and [54.0, 66.0]."
    )


@pytest.mark.parametrize("reference", ["bins", "visible"])
def test_the_paired_interval_decides_where_there_is_one(reference: str) -> None:
    assert told(reference, bins=40, visible=36).endswith(
        "by more than chance: the 95 % interval of their difference is +5.0 to +11.0 points."
    )
    assert told(reference, bins=36, visible=35).endswith(
        "which of the first two is better: the 95 % interval of their difference is -1.0 to +5.0 points."
    )


def test_two_that_chose_alike_need_no_interval() -> None:
    table = make_scores(("random", "bins", "visible"), "bins", (1,), ("a",))
    rows = table["method"] == "visible"
    table.loc[rows, [name for name in table.columns if name.startswith("difference_")]] = 0.0
    assert best_in_words(table).endswith("knows, at 45. The first two chose equally well everywhere.")


def test_views_of_several_at_a_location_are_counted() -> None:
    assert "0.4° 180 of 250 times (5 views at each of 50 locations); forward 175, random " in told(
        n=5, bins=36, forward=35
    )


def test_too_few_for_an_interval_and_one_method_alone() -> None:
    table = make_scores(("random", "bins", "visible"), None, (1,), ("a",))
    ends = [name for name in table.columns if "_low_" in name or "_high_" in name]
    table[ends] = np.nan
    assert best_in_words(table).endswith("which of the first two is better: there are too few for an interval.")
    alone = best_in_words(table[table["method"].isin(["bins", "oracle"])])
    assert alone.endswith("and the oracle, which knows, at 45.") and "better" not in alone
    probes = make_scores(("bins", "fisher-worst-trace"), None, (1,), ("a",))
    probes.loc[probes["method"] == "fisher-worst-trace", f"raw_{FINEST}"] = 0.9
    assert best_in_words(probes).startswith("Reprojections with bins")
