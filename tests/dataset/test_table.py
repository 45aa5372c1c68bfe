"""The table on disk: schema, poses, labels, damage."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from wheretolook.dataset.viewpoint_files import MATCH_FIELDS, SCHEMA, read_table, write_table
from wheretolook.dataset.viewpoint_table import is_good, pose_columns, poses
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import fingerprint


@pytest.fixture
def table():
    rng = np.random.default_rng(0)
    truth = poses_looking_along(rng.normal(size=(5, 3)), rng.normal(size=(5, 3)))
    return pd.DataFrame(
        {
            "viewpoint_id": np.arange(5),
            "location_id": 0,
            "direction_id": np.arange(5),
            **pose_columns(truth),
            "n_visible": 7,
            "visibility_rank": np.arange(5),
            "status": ["localized", "localized", "localized", "no_pose", "too_few_matches"],
            "error_m": [0.049, 0.05, 0.01, np.nan, np.nan],
            "error_deg": [0.39, 0.1, 0.41, np.nan, np.nan],
            "n_inliers": [20, 30, 12, 0, 0],
        }
    )


def test_round_trip_and_equal_bytes(table, tmp_path):
    write_table(table, tmp_path / "a.parquet")
    write_table(table, tmp_path / "b.parquet")
    back = read_table(tmp_path / "a.parquet")
    assert list(back.columns) == SCHEMA.names
    assert_allclose(poses(back), poses(table), atol=1e-15)
    assert fingerprint(tmp_path / "a.parquet") == fingerprint(tmp_path / "b.parquet")
    assert not list(tmp_path.glob("*.partial"))


@pytest.fixture
def matched(table):
    """Views with many matches, one, and none; of two, all are inliers."""
    matches = [np.arange(0, 90, 3), np.arange(30), np.arange(7, 20), np.array([1_000_000]), np.zeros(0)]
    inliers = [np.arange(0, 60, 3), np.arange(30), np.arange(8, 20), np.zeros(0), np.zeros(0)]
    columns = {"matched_rows": matches, "inlier_rows": inliers}
    return table.assign(**{name: [one.astype(np.int32) for one in rows] for name, rows in columns.items()})


def test_matches_are_read_on_request(matched, tmp_path):
    path = tmp_path / "a.parquet"
    write_table(matched, path)
    back = read_table(path, matches=True)
    assert list(back.columns) == [*SCHEMA.names, *MATCH_FIELDS.names]
    for name in MATCH_FIELDS.names:
        assert all(isinstance(rows, np.ndarray) and rows.dtype == np.int32 for rows in back[name])
        assert [rows.tolist() for rows in back[name]] == [rows.tolist() for rows in matched[name]]
    write_table(back, tmp_path / "again.parquet")
    assert fingerprint(tmp_path / "again.parquet") == fingerprint(path)
    assert list(read_table(path).columns) == SCHEMA.names


def test_labels_are_strict_at_both_limits(table):
    assert is_good(table).tolist() == [True, False, False, False, False]
    assert is_good(table, 0.25, 2).tolist() == [True, True, True, False, False]
    with pytest.raises(TableError):
        is_good(table.assign(status="unlabelled"))


@pytest.fixture
def many(table):
    """Forty locations with fifty directions each, in no order."""
    rng = np.random.default_rng(1)
    locations = rng.uniform(-20, 20, (40, 3))
    directions = rng.normal(size=(50, 3))
    truth = poses_looking_along(np.repeat(locations, 50, axis=0), np.tile(directions, (40, 1)))
    rows = table.iloc[rng.integers(0, 5, len(truth))].reset_index(drop=True)
    rows = rows.assign(
        viewpoint_id=np.arange(len(truth)), location_id=np.arange(len(truth)) // 50,
        direction_id=np.arange(len(truth)) % 50, **pose_columns(truth),
        error_m=np.where(rows["error_m"].isna(), np.nan, rng.random(len(truth))),
    )  # fmt: skip
    return rows.sample(frac=1, random_state=0).reset_index(drop=True)


def test_a_compact_table_reads_the_same(many, tmp_path):
    plain, compact, again = (tmp_path / f"{name}.parquet" for name in ("plain", "compact", "again"))
    write_table(many, plain)
    write_table(many, compact, compact=True)
    write_table(read_table(compact), again, compact=True)
    assert compact.read_bytes() == again.read_bytes()
    assert compact.stat().st_size < plain.stat().st_size / 2
    back = read_table(compact)
    before = read_table(plain)
    translation = ["tx", "ty", "tz"]
    pd.testing.assert_frame_equal(back.drop(columns=translation), before.drop(columns=translation))
    assert_allclose(back[translation], before[translation], rtol=0, atol=1e-12)
    # the centre of a location is stored once, where anyone reads it without arithmetic
    columns = pd.read_parquet(compact)
    assert columns.groupby("location_id")[["x_m", "y_m", "z_m"]].nunique().to_numpy().max() == 1
    centers = camera_centers(poses(before))
    assert_allclose(columns[["x_m", "y_m", "z_m"]], centers, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["appearance", "changes"])
@pytest.mark.parametrize("compact", [False, True])
def test_strengths_are_kept(compact, name, many, tmp_path):
    strengths = np.random.default_rng(0).random(len(many)).astype(np.float32)
    write_table(many.assign(**{name: strengths}), tmp_path / "a.parquet", compact)
    back = read_table(tmp_path / "a.parquet")
    assert [*back] == [*SCHEMA.names, name]
    assert_array_equal(back[name].to_numpy(), strengths)


@pytest.mark.parametrize("compact", [False, True])
def test_damaged_files(compact, many, tmp_path):
    path = tmp_path / "viewpoints.parquet"
    write_table(many, path, compact)
    whole = path.read_bytes()
    middle = len(whole) // 2
    for damaged in (b"", whole[:-50], whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]):
        path.write_bytes(damaged)
        with pytest.raises(TableError):
            read_table(path)


@pytest.mark.parametrize(
    "change",
    [
        {"qw": 2.0},
        {"x_m": np.nan},
        {"error_m": "near"},
        {"error_m": None},
        {"n_visible": pd.NA},
        {"location_id": pd.NA},
        {"viewpoint_id": 1},
    ],
)
def test_columns_that_are_missing_or_invalid(change, many, tmp_path):
    path = tmp_path / "viewpoints.parquet"
    write_table(many, path, compact=True)
    columns = pd.read_parquet(path)
    (name, value), *_ = change.items()
    (columns.drop(columns=name) if value is None else columns.assign(**{name: value})).to_parquet(path)
    with pytest.raises(TableError):
        read_table(path)


def test_matches_that_are_not_stored(table, matched, tmp_path):
    path = tmp_path / "viewpoints.parquet"
    for content, compact in ((table, False), (matched.drop(columns="inlier_rows"), False), (matched, True)):
        write_table(content, path, compact)
        with pytest.raises(TableError):
            read_table(path, matches=True)
