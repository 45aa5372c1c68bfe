"""Paths on a map of photographs: a rendered room, seen from a ring of cameras that face across it."""

import numpy as np
import pandas as pd
import pytest

from holdout.rendered_room import write_rendered_room
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.holdout.photo_map import features_of, open_map
from wheretolook.mapping.config import FrameOptions
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.errors import PlanningError
from wheretolook_paper.evaluation.comparison import replace_rows
from wheretolook_paper.figures.paths import AXIS, LANDMARKS_CSV, PATHS_CSV, POSITION
from wheretolook_paper.studies.plan_photographs import farthest_ends, main, nearest_photographs


def test_the_nearest_photograph_weighs_the_angle_against_the_distance_in_depths():
    forward = np.array([0.0, 1.0, 0.0])
    turned = np.array([np.sin(0.3), np.cos(0.3), 0.0])
    poses = poses_looking_along([(0, 0, 1), (1, 0, 1), (0, 0, 1)], [turned, forward, -forward])
    view = np.array([[0.0, 0.0, 1.0]]), forward[None]
    row, distance_m, angle_deg = nearest_photographs(*view, poses, depth_m=2.0)  # 1 m at 2 m: 0.5 against 0.3
    assert (row, distance_m) == (0, 0) and angle_deg == pytest.approx(np.degrees(0.3))
    row, distance_m, angle_deg = nearest_photographs(*view, poses, depth_m=5.0)  # 0.2 against 0.3
    assert (row, distance_m) == (1, 1) and angle_deg == pytest.approx(0, abs=1e-6)


def test_ends_are_the_farthest_photographs_that_free_space_connects():
    """Three cameras along a line, and two farther ones behind a wall of landmarks."""
    centers = np.array([(0, 0, 1), (1, 0, 1), (2, 0, 1), (3.2, 0, 1), (4.2, 0, 1)], dtype=float)
    y, z = np.meshgrid(np.arange(-3, 3, 0.1), np.arange(-2, 4, 0.1))
    wall = np.column_stack([np.full(y.size, 2.6), y.ravel(), z.ravel()])
    assert farthest_ends(MappedSpace(wall, centers), centers, 1.5) == (0, 2)
    assert farthest_ends(MappedSpace(wall[:1], centers), centers, 1.5) == (0, 4)  # no wall
    with pytest.raises(PlanningError, match="connected"):
        farthest_ends(MappedSpace(wall, centers), centers, 0.5)


def test_rows_of_other_scenes_are_kept(tmp_path):
    file = tmp_path / "table.csv"
    for scene, value in (("b", 1), ("a", 2), ("b", 3)):
        replace_rows(file, pd.DataFrame({"scene": [scene], "value": [value]}), ["scene"])
    assert pd.read_csv(file).to_numpy().tolist() == [["a", 2], ["b", 3]]


@pytest.mark.slow
def test_paths_through_a_rendered_room(tmp_path):
    write_rendered_room(tmp_path)
    photographs = tmp_path / "photographs"
    model, database = features_of(tmp_path / "sparse", photographs, None, tmp_path / "mapped", 1, "cpu")
    out = tmp_path / PATHS_CSV
    frame = FrameOptions(scale=1)
    figure = tmp_path / "paths.png"
    shown = {"images": photographs, "figure": figure}
    main(model, tmp_path / "work", "room", database, frame=frame, time_s=8.0, out=out, **shown)
    table = pd.read_csv(out)
    source = open_map(model, database, frame=frame)
    assert list(table["method"].unique()) == ["forward", "fisher-trace-gp", "set"]
    assert figure.is_file() and set(pd.read_csv(tmp_path / LANDMARKS_CSV)["scene"]) == {"room"}

    # ends are photographs' places, and the nearest photograph by either measure is no nearer than the one found
    centers = camera_centers(source.poses)
    at, axes = (table[names].to_numpy() for names in (POSITION, AXIS))
    distance_m = np.linalg.norm(centers - at[:, None], axis=2)
    angle_deg = np.degrees(np.arccos(np.clip(axes @ source.poses[:, 2, :3].T, -1, 1)))
    ends = ~(table["method"].duplicated() & table["method"].duplicated(keep="last"))
    assert distance_m[ends].min(1) == pytest.approx(0, abs=1e-3)
    rows = (np.arange(len(table)), [source.names.index(name) for name in table["image"]])
    distance, angle = table[["distance", "angle_deg"]].to_numpy().T
    assert distance == pytest.approx(distance_m[rows], abs=1e-3)
    assert angle == pytest.approx(angle_deg[rows], abs=0.5)  # stored axes are rounded
    assert not ((distance_m < distance[:, None] - 1e-3) & (angle_deg < angle[:, None] - 0.5)).any()

    means = table.groupby("method")[["visible", "probability"]].mean()
    assert (means.loc["set"] >= means.loc["forward"]).all() and means.loc["forward", "visible"] > 0
    near = table[table["localized"] == 1]
    assert len(near) and (near["error"] < 0.05).all() and (near["error_deg"] < 0.4).all()
    assert set(table["unit"]) == {"m"} and set(table["photographs"]) == {24}
