"""Paths are read from every file that holds poses; states survive text and links."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from selection.room import POINTS
from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.pose_files import tum_text
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.planning.config import FORWARD
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.view.state import ViewState, looking_ahead, read_paths

STATE = ViewState("visible", "none", 3, 0.25, 1.4, 2.0, (1.0, 2.0, 1.5), -30.0, 5.0, (0.0, 0.0, 9.0), (1.0, 1.0, 0.0))


def test_states_survive_text_and_link():
    far = replace(STATE, place=(431207.125, 5412345.5, 312.046), cut=1234.05)
    for state in (STATE, ViewState(), far):
        assert ViewState.parse(state.text()) == state
    link = STATE.link("localhost:8080")
    assert not {*link.partition("?")[2]} & {*' &#%+"<>'}  # needs no escaping
    assert ViewState.of_path("/" + link.rpartition("/")[2]) == STATE and ViewState.of_path("/?other=1") is None


@pytest.mark.parametrize(
    "text",
    ["n=0", "n=x", "height=nan", "place=1,2", "place=1,2,inf", "what=1", "n", "x" * 3000, "eye=1,2,3;target=1,2,3"],
)
def test_invalid_states(text):
    with pytest.raises(ConfigError):
        ViewState.parse(text)


def test_a_path_is_shown_next_to_a_camera_that_looks_ahead(tmp_path):
    poses = poses_looking_along(POINTS, np.tile((-1.0, -0.5, 0.0), (4, 1)))
    pd.DataFrame({"score": 0.5, **pose_columns(poses)}).to_csv(tmp_path / "path.csv", index=False)
    (tmp_path / "way.tum").write_text(tum_text("0123", poses))
    for name, method in (("", "planned"), ("way.tum", "way")):
        paths = read_paths(tmp_path / name)
        assert [*paths] == [FORWARD, method] and paths[method].good is None
        np.testing.assert_allclose(paths[method].cam_from_world, poses, atol=1e-5)
        np.testing.assert_allclose(camera_centers(paths[FORWARD].cam_from_world), POINTS, atol=1e-5)


def test_compared_paths_have_labels_if_there_are_any(tmp_path):
    poses = looking_ahead(POINTS)
    rows = pd.DataFrame({**pose_columns(poses), "pair": 1, "task": "planned", "waypoint": range(4)})
    table = pd.concat([rows.assign(method=method) for method in ("forward", "set")])
    scene = tmp_path / "paths" / "compared"
    scene.mkdir(parents=True)
    table.to_parquet(scene / "views.parquet")
    assert read_paths(scene, 1)["set"].good is None
    far = np.where(table["method"] == "forward", 1.0, 0.01)
    labelled = table.assign(scene="compared", status="localized", error_m=far, error_deg=0.1)
    labelled.to_parquet(scene.parent / "views.parquet")
    localized = [path.good for path in read_paths(scene, 1).values()]
    np.testing.assert_array_equal(localized, [[False] * 4, [True] * 4])
    with pytest.raises(TableError):
        read_paths(scene, 7)


def test_looking_ahead_follows_the_path_and_keeps_direction_where_it_stops():
    positions = np.array([(0.0, 0, 1), (0, 0, 1), (1, 0, 1), (1, 2, 1.5), (1, 2, 1.5)])
    axes = looking_ahead(positions)[:, 2, :3]
    np.testing.assert_allclose(axes, [(1, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 0), (0, 1, 0)], atol=1e-12)


def write_table(folder, **columns):
    poses = pose_columns(np.tile(np.eye(3, 4), (30, 1, 1)))
    table = pd.DataFrame({**poses, "pair": 0, "task": "planned", "waypoint": range(30), "method": "set"})
    table.assign(**columns).to_parquet(folder / "views.parquet")


def write_large_table(folder):
    table = pa.table({"pair": pa.array(np.zeros(20_000_000, dtype=np.int64))})  # 160 MB in a few kilobytes
    pq.write_table(table, folder / "views.parquet", compression="zstd")


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("path.tum", lambda folder: (folder / "path.tum").write_text("")),
        ("path.tum", lambda folder: (folder / "path.tum").write_text("0 1 2 3 0 0 0 1\n")),
        ("path.tum", lambda folder: (folder / "path.tum").write_text("0 1 2 3 0 0 0 0\n" * 2)),
        ("views.parquet", lambda folder: write_table(folder, tx=1e300)),
        ("views.parquet", lambda folder: write_table(folder, qw=np.nan)),
        ("views.parquet", lambda folder: write_table(folder, method=[f"m{row}" for row in range(30)])),
        ("views.parquet", write_large_table),
    ],
)
def test_invalid_paths(name, write, tmp_path):
    write(tmp_path)
    with pytest.raises(TableError):
        read_paths(tmp_path / name)
