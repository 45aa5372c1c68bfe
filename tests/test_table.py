"""The table on disk: schema, poses, labels, damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from wheretolook.errors import TableError
from wheretolook.geometry import poses_looking_along
from wheretolook.table import SCHEMA, fingerprint, is_good, pose_columns, poses, read_table, write_table


@pytest.fixture
def table() -> pd.DataFrame:
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


def test_round_trip_and_equal_bytes(table: pd.DataFrame, tmp_path: Path) -> None:
    write_table(table, tmp_path / "a.parquet")
    write_table(table, tmp_path / "b.parquet")
    back = read_table(tmp_path / "a.parquet")
    assert list(back.columns) == SCHEMA.names
    np.testing.assert_allclose(poses(back), poses(table), atol=1e-15)
    assert fingerprint(tmp_path / "a.parquet") == fingerprint(tmp_path / "b.parquet")
    assert not list(tmp_path.glob("*.partial"))


def test_labels_are_strict_at_both_limits(table: pd.DataFrame) -> None:
    assert is_good(table).tolist() == [True, False, False, False, False]
    assert is_good(table, 0.25, 2).tolist() == [True, True, True, False, False]


def test_unlabelled_rows_are_named(table: pd.DataFrame) -> None:
    with pytest.raises(TableError, match=r"without labels \(got 1\)"):
        is_good(table.assign(status=["unlabelled", *table["status"][1:]]))


def test_missing_truncated_and_foreign_files(table: pd.DataFrame, tmp_path: Path) -> None:
    path = tmp_path / "viewpoints.parquet"
    with pytest.raises(TableError, match="sample stage"):
        read_table(path)
    write_table(table, path)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(TableError, match=r"viewpoints\.parquet.*truncated"):
        read_table(path)
    write_table(table.assign(qw=0.0, qx=0.0, qy=0.0, qz=0.0), path)
    with pytest.raises(TableError, match="no rigid transform"):
        read_table(path)
    table.assign(error_m="near").to_parquet(path)
    with pytest.raises(TableError, match="another type"):
        read_table(path)
    table.drop(columns="error_m").to_parquet(path)
    with pytest.raises(TableError, match="error_m"):
        read_table(path)
