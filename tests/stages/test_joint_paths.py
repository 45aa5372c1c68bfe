"""Views of compared paths localized together: the looks of a stop, and the last views as odometry tells them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from planning.rooms import CAMERA, room_landmarks
from wheretolook.dataset.environment import Scene
from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import pose_columns, poses
from wheretolook.geometry.poses import pose_error, poses_looking_along, rotation_angle_deg
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.planning.config import PathsConfig, StopConfig
from wheretolook.utils.errors import ConfigError
from wheretolook_paper.commands.joint_paths import KEY, OUTCOME, check_joint, localize_together
from wheretolook_paper.figures.paths import paths_figure
from wheretolook_paper.paths.odometry import chained, rig_of_last, told_steps
from wheretolook_paper.paths.path_comparison import ComparedPaths
from wheretolook_paper.paths.path_report import path_markdown, summarize_paths

LANDMARKS = room_landmarks(900)
POSITIONS = np.linspace((1.0, 0.9, 1.3), (3.0, 0.9, 1.3), 6)
AXES = np.tile((0.2, 1.0, 0.0), (6, 1)) / np.hypot(0.2, 1)
BLIND = 3  # where the path's view matches nothing right
METHODS = ("forward", "set", "set greedy")  # the last by another rule, which has neither stops nor views together
CONFIG = PathsConfig(methods=("forward", "set"), stops=StopConfig(2, 0.7), last_views=3, resamples=50)


def seen(cam_from_world: np.ndarray, blind: np.ndarray, seed: int = 0) -> pd.DataFrame:
    """What views (B, 3, 4) match, nothing right where they are blind, and what comes of localizing each alone."""
    rng = np.random.default_rng(seed)
    estimator = PoseEstimator(LANDMARKS.points)
    rows = []
    for pose, wrong in zip(cam_from_world, blind, strict=True):
        there = LANDMARKS.points @ pose[:, :3].T + pose[:, 3]
        at = CAMERA.project(there)
        visible = np.flatnonzero((there[:, 2] > 0.1) & CAMERA.in_image(at))
        visible = np.sort(rng.choice(visible, min(40, len(visible)), replace=False))
        pixels = rng.uniform((0, 0), (160, 120), (len(visible), 2)) if wrong else at[visible]
        pixels = (pixels + rng.normal(0, 0.2, pixels.shape)).astype(np.float32)
        found = estimator.estimate(pixels, visible, CAMERA)
        inliers = 0 if found is None else int(found[1].sum())
        error_m, error_deg = (np.nan, np.nan) if found is None else pose_error(found[0], pose)
        status = "localized" if inliers >= 10 else "no_pose"
        matched = {"matched_rows": visible.astype(np.int32), "matched_pixels": pixels.ravel(), "location_id": len(rows)}
        rows.append(
            {"status": status, "error_m": float(error_m), "error_deg": float(error_deg), "n_inliers": inliers} | matched
        )
    return pd.DataFrame(rows).assign(**pose_columns(cam_from_world))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    files = SceneFolder(tmp_path_factory.mktemp("data") / "rooms" / "room", "test", CAMERA)
    files.map.mkdir(parents=True)
    LANDMARKS.save(files.landmarks)
    return Scene(files, device="cpu")


@pytest.fixture(scope="module")
def compared() -> tuple[ComparedPaths, pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """The same way by two methods, with a stop at the blind place of one; paths, further looks, and labels of both."""
    pose = poses_looking_along(POSITIONS, AXES)
    labels = pd.concat([seen(pose, np.arange(6) == BLIND, seed) for seed in (0, 1)], ignore_index=True)
    about = {"pair": 0, "task": "planned", "waypoint": np.tile(np.arange(6), 2), "score": 0.5}
    views = pd.DataFrame({**about, "method": np.repeat(["forward", "set"], 6)}).join(labels[OUTCOME])
    views = views.assign(**pose_columns(np.tile(pose, (2, 1, 1))))
    views, labels = (pd.concat([all_of, all_of.iloc[6:]], ignore_index=True) for all_of in (views, labels))
    views.loc[12:, "method"] = "set greedy"
    path = {"pair": 0, "task": "planned", "planned": True, "length_m": 2.0, "turn_deg": 0.0, "n_views": 6}
    paths = pd.DataFrame([{**path, "method": name, "promised": 0.5, "found_by": ""} for name in METHODS])
    aside = poses_looking_along(POSITIONS[[BLIND]], np.array([(0.0, -1.0, 0.0)]))
    stop = {"pair": 0, "task": "planned", "method": "set", "waypoint": BLIND, "look": 2, "score": 0.6}
    further = pd.DataFrame([{**stop, "together": 0.8, "turn_deg": 350.0}]).assign(**pose_columns(aside))
    return ComparedPaths(paths, views), further, labels, seen(aside, np.array([False]))


def test_looks_of_a_stop_and_the_last_views_localize_where_one_view_does_not(
    scene: Scene, compared: tuple, tmp_path: Path
) -> None:
    single, further, labels, further_labels = compared
    near = (single.views["status"] == "localized") & (single.views["error_m"] < 0.25)
    assert near.tolist() == [number % 6 != BLIND for number in range(18)]
    given = (scene, CONFIG, LocalizerConfig(), tmp_path)
    found = localize_together(single, further, labels, further_labels, *given, ["a"])
    assert list(dict.fromkeys(found.paths["method"])) == [
        "set with stops",
        "forward last 3 together",
        "set last 3 together",
    ]
    assert found.views.groupby("method").size().to_dict() == dict.fromkeys(found.paths["method"], 6)
    both = ComparedPaths(
        pd.concat([single.paths.assign(n_looks=6), found.paths], ignore_index=True).assign(scene="room"),
        pd.concat([single.views, found.views], ignore_index=True).assign(scene="room"),
    )
    table = summarize_paths(both.paths, both.views, CONFIG).set_index("method")
    for name in ("forward", "set"):
        assert table.loc[name, "localized"] == pytest.approx(5 / 6) and table.loc[name, "looks"] == 1
        assert table.loc[f"{name} last 3 together", "localized"] == 1
    stopped = table.loc["set with stops"]
    assert stopped["localized"] == 1 and stopped["looks"] == pytest.approx(7 / 6)
    assert stopped["turn_deg_per_m"] == pytest.approx(175) and stopped["promised"] == pytest.approx((5 * 0.5 + 0.8) / 6)
    stop = found.views[found.views["method"] == "set with stops"].set_index("waypoint")
    own = single.views[single.views["method"] == "set"].set_index("waypoint")
    pd.testing.assert_frame_equal(stop[OUTCOME].drop(BLIND), own[OUTCOME].drop(BLIND))
    assert stop.loc[BLIND, "error_m"] < 0.05 and stop.loc[BLIND, "score"] == 0.8
    text = path_markdown(table.reset_index(), CONFIG)
    assert "| looks a place |" in text and "| set with stops " in text
    (axes,) = paths_figure(table.reset_index()).axes
    assert "landmarks, with stops" in " ".join(axes.get_legend_handles_labels()[1]).lower()


def test_what_was_localized_together_is_used_again(scene: Scene, compared: tuple, tmp_path: Path) -> None:
    single, further, labels, further_labels = compared
    config = replace(CONFIG, last_views=2)

    def views(config: PathsConfig, made_from: str) -> tuple[pd.DataFrame, float]:
        found = localize_together(
            single, further, labels, further_labels, scene, config, LocalizerConfig(), tmp_path, [made_from]
        )
        return found.views, (tmp_path / "last-together.parquet").stat().st_mtime_ns

    first = views(config, "a")
    again = views(config, "a")
    pd.testing.assert_frame_equal(first[0], again[0])
    assert first[1] == again[1]
    other = views(config, "b")
    noisy = views(replace(config, odometry_m_per_m=0.2), "b")
    assert again[1] < other[1] < noisy[1]
    last = other[0]["method"].str.contains("last")
    np.testing.assert_allclose(other[0][last]["error_m"], first[0][last]["error_m"], rtol=1e-6)
    assert noisy[0][last]["error_m"].median() > other[0][last]["error_m"].median()


def test_odometry_without_noise_is_the_way_itself() -> None:
    rng = np.random.default_rng(0)
    way = poses_looking_along(rng.uniform(-2, 2, (6, 3)), rng.normal(size=(6, 3)))
    steps = told_steps(way, 0.0, 0.0, rng)
    for view, n in ((0, 3), (1, 3), (4, 3), (5, 6)):
        rig = rig_of_last(steps, view, n)
        assert len(rig) == min(n, view + 1)
        for back, mount in enumerate(rig):
            np.testing.assert_allclose(chained(mount, way[view]), way[view - back], atol=1e-9)


def test_odometry_is_off_by_a_share_of_each_step() -> None:
    way = poses_looking_along([(0, 0, 0), (2.0, 0, 0)], [(1, 0, 0), (np.cos(0.5), np.sin(0.5), 0)])
    rng = np.random.default_rng(1)
    true = told_steps(way, 0, 0, rng)[0]
    told = np.array([told_steps(way, 0.01, 0.02, rng)[0] for _ in range(1500)])
    np.testing.assert_allclose((told[:, :, 3] - true[:, 3]).std(0), 0.02, rtol=0.1)
    angle = rotation_angle_deg(told[:, :, :3], true[:, :3])
    assert np.sqrt((angle**2).mean()) == pytest.approx(np.sqrt(3) * 0.02 * np.degrees(0.5), rel=0.1)


def test_stops_are_refused_where_no_method_can(compared: tuple) -> None:
    check_joint(CONFIG)
    check_joint(replace(CONFIG, methods=("forward", "visible"), stops=StopConfig()))
    with pytest.raises(ConfigError, match="probabilities"):
        check_joint(replace(CONFIG, methods=("forward", "visible")))
    assert {*KEY} <= {*compared[0].views}
    assert len(poses(compared[1])) == 1


def test_where_no_place_is_a_stop_nothing_changes(scene: Scene, compared: tuple, tmp_path: Path) -> None:
    single, further, labels, _ = compared
    config = replace(CONFIG, last_views=1)
    nothing = pd.DataFrame(columns=further.columns[:8])
    found = localize_together(
        single, nothing, labels, pd.DataFrame(), scene, config, LocalizerConfig(), tmp_path, ["a"]
    )
    own = single.views[single.views["method"] == "set"].reset_index(drop=True)
    pd.testing.assert_frame_equal(found.views.drop(columns="method"), own.drop(columns="method"))
    assert found.paths[["method", "turn_deg", "n_looks"]].to_numpy().tolist() == [["set with stops", 0.0, 6]]
