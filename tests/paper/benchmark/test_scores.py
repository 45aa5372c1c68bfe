"""Both measures against numbers worked out by hand, and against the released scripts said again in plain loops."""

import math

import numpy as np
import pytest

from wheretolook.geometry.poses import poses_looking_along
from wheretolook.utils.errors import TableError
from wheretolook_paper.benchmark.files import read_errors, read_poses, write_errors, write_poses
from wheretolook_paper.benchmark.report import PLAN, Result, Scores, summary_table, summary_text

YAWS = (0, 25, 50, 90, 100, 100, 100, 100, 100, 100, 100)  # the fourth view is 40 degrees from the third
ERRORS = {  # metres and degrees of each id
    "1": (0.05, 0.4),  # on the limit: within
    "2": (0.2, 1.9),
    "3": (0.25, 2.0),  # on the limit of the plan
    "4": (0.01, 0.1),  # good, but reached by 40 degrees
    "5": (0.0500001, 0.1),
    "6": (0.4, 4.9),
    "7": (4.9, 9.9),
    "8": (math.nan, math.nan),
    "9": (0.01, 11.0),
    "10": (0.02, 0.2),
    "11": (6.0, 0.1),
}


def write_case(folder, ids, errors, yaws):
    axes = [(math.cos(math.radians(yaw)), math.sin(math.radians(yaw)), 0) for yaw in yaws]
    write_poses(folder / "selected_gt_poses.txt", ids, poses_looking_along(np.zeros((len(ids), 3)), axes))
    write_errors(folder / "pose_errors.txt", list(errors), *np.array(list(errors.values())).T)
    return folder


def scores_of(folder):
    return Scores.of(read_poses(folder / "selected_gt_poses.txt"), read_errors(folder / "pose_errors.txt"))


def loc_as_released(errors):
    """evaluate_loc.py, said again: lines of three words count; limits inclusive; over the number of lines."""
    lines = [line.split() for line in errors.read_text().splitlines()]
    pairs = [(float(line[1]), float(line[2])) for line in lines if len(line) == 3]
    limits = [(0.05, 0.4), (0.25, 2.0), (0.5, 5.0), (5.0, 10.0)]
    return [(sum(m <= most_m and d <= most_d for m, d in pairs), len(pairs)) for most_m, most_d in limits]


def plan_as_released(errors, poses):
    """evaluate_plan.py, said again: the n-th error with the n-th pose; it stops if their numbers differ."""
    lines = [line.split() for line in errors.read_text().splitlines()]
    pairs = [(float(line[1]), float(line[2])) for line in lines if len(line) == 3]
    quaternions = np.loadtxt(poses, dtype=str, ndmin=2)[:, 1:5].astype(float)
    if len(pairs) != len(quaternions):
        return None
    cosines = np.abs((quaternions[1:] * quaternions[:-1]).sum(1)).clip(max=1)
    turns = [0.0, *np.degrees(2 * np.arccos(cosines))]
    good = [m <= 0.25 and d <= 2 and turn <= 30 for (m, d), turn in zip(pairs, turns, strict=True)]
    return sum(good), len(pairs)


def hits(counted):
    return int(counted.sum()), len(counted)


def test_numbers_worked_out_by_hand(tmp_path):
    scores = scores_of(write_case(tmp_path, list(ERRORS), ERRORS, YAWS))
    # ids within each limit: 1 4 10; and 2 3 5; and 6; and 7
    expected = {"0.05m_0.4deg": 3, "0.25m_2deg": 6, "0.5m_5deg": 7, "5m_10deg": 8, PLAN: 5}
    assert {name: hits(counted) for name, counted in scores.mended.items()} == {k: (n, 11) for k, n in expected.items()}
    np.testing.assert_allclose(scores.turns_deg, np.abs(np.diff(YAWS, prepend=0)), atol=1e-9)
    # by row the lines 1 10 11 2 3 4 5 6 7 8 9 meet the poses 1 2 3 4 ...: 2 gets the 40 degrees, 4 does not
    views = Result("scene", "method", scores).views().set_index("id")
    assert [*views["as_shipped_error_of"]] == ["1", "10", "11", "2", "3", "4", "5", *"6789"]
    assert [name for name in ERRORS if views.loc[name, PLAN]] == ["1", "2", "3", "5", "10"]
    shipped = views[views["as_shipped_plan"] == 1]["as_shipped_error_of"]
    assert [*shipped] == ["1", "10", "3", "4", "5"]


@pytest.mark.parametrize("seed", range(3))
def test_as_shipped_is_what_the_scripts_compute(seed, tmp_path):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 40))
    ids = [str(number) for number in rng.permutation(n)]
    limits = rng.choice([0.05, 0.25, 0.5, 5.0, 7.0, 0.01], n), rng.choice([0.4, 2.0, 5.0, 10.0, 20.0, 0.1], n)
    failed = rng.random(n) < 0.2
    kept = [row for row in range(n) if seed % 3 or row]  # of every third, the first has no line
    errors = {ids[row]: (np.nan, np.nan) if failed[row] else (limits[0][row], limits[1][row]) for row in kept}
    folder = write_case(tmp_path, ids, errors, tuple(np.cumsum(rng.uniform(0, 60, n))))
    poses = folder / "selected_gt_poses.txt"
    lines = folder / "pose_errors.txt"
    scores = scores_of(folder)
    shipped = [hits(counted) for counted in scores.as_shipped.values()]
    plan = plan_as_released(lines, poses)
    assert shipped == loc_as_released(lines) + ([plan] if plan else [])
    assert (plan is None) == (len(kept) < n)
    # joined by id is what the script computes where both files stand in one order, and no line is missing
    in_order = [f"{name} {m} {d}" for name, m, d in zip(ids, scores.metres, scores.degrees, strict=True)]
    lines.write_text("\n".join(in_order))
    mended = [hits(counted) for counted in scores.mended.values()]
    assert mended == [*loc_as_released(lines), plan_as_released(lines, poses)]


def test_files_of_the_benchmarks_own_script(tmp_path):
    """It writes the image's name where it found no pose, strips p, n, g and dots off others, and ends lines so."""
    poses = poses_looking_along(np.zeros((3, 3)), np.tile([1.0, 0, 0], (3, 1)))
    write_poses(tmp_path / "selected_gt_poses.txt", ["7", "gap", "12"], poses)
    (tmp_path / "pose_errors.txt").write_text("12 0.01 0.1\n7.png nan nan \na 0.3 1.0\n")
    np.testing.assert_array_equal(scores_of(tmp_path).metres, [np.nan, 0.3, 0.01])


def test_a_pose_without_an_error_has_failed_and_the_script_stops(tmp_path):
    few = {name: ERRORS[name] for name in ("1", "2", "4")}
    whole = Result("a", "m", scores_of(write_case(tmp_path, ["1"], {"1": (0.01, 0.1)}, (0,))))
    summary = summary_table([whole, Result("b", "m", scores_of(write_case(tmp_path, list(ERRORS), few, YAWS)))])
    summary = summary.set_index(["scene", "measure"])
    assert summary.loc[("b", "0.05m_0.4deg"), ["as_shipped_hits", "as_shipped_total"]].tolist() == [2, 3]
    assert summary.loc[("b", PLAN), ["mended_hits", "mended_total"]].tolist() == [2, 11]
    assert summary.loc[[("b", PLAN), ("all", PLAN)], "as_shipped_hits"].isna().all()
    assert "stops" in summary_text(summary.reset_index())
    # scenes are pooled, not averaged
    pooled = summary.loc[("all", "0.05m_0.4deg")]
    assert (pooled["mended_hits"], pooled["mended_total"]) == (3, 12)
    assert pooled["as_shipped_percent"] == pytest.approx(75)


@pytest.mark.parametrize(
    "text", ["1 0.1 0.1\n1 0.2 0.2\n", "1 0.1\n", "1 0.1 x\n", "# a comment\n", "1 0.1 0.1\n99 0.1 0.1\n"]
)
def test_invalid_errors(text, tmp_path):
    write_case(tmp_path, ["1"], {"1": (0.1, 0.1)}, (0,))
    (tmp_path / "pose_errors.txt").write_text(text)
    with pytest.raises(TableError):
        scores_of(tmp_path)
