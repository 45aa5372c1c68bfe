"""`wheretolook check` on a corridor whose photographs, landmarks and descriptors are known."""

import json
import shutil

import numpy as np
import pandas as pd
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from holdout.corridor import ALONE, N, corridor_poses, write_corridor
from holdout.rendered_room import write_rendered_room
from selection.room import WEIGHTS
from wheretolook.cli import parse_command
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.holdout.holdout import KEPT, MIN_REST, Block, choose_blocks, hold_out_blocks, landmarks_kept, without
from wheretolook.holdout.photo_map import open_map
from wheretolook.holdout.report import CheckReport
from wheretolook.holdout.scores import whole_map
from wheretolook.mapping.colmap_model import model_arrays, observation_matrix, read_model
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.map import find_source
from wheretolook.scorers.adapted.score import AdaptedNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.set.score import for_map
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, WeightsError
from wheretolook.visibility.hidden_points import HiddenPointRemoval


def run(arguments):
    parse_command("check", arguments).run()


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    return write_corridor(tmp_path_factory.mktemp("corridor"))


@pytest.fixture(scope="module")
def checked(corridor, tmp_path_factory):
    out = tmp_path_factory.mktemp("checked") / "out"
    run(_arguments(*corridor, out, "--scale", "1", "--also", "bins"))
    return out


def _arguments(sparse, database, out, *more):
    where = ["--map", str(sparse), "--database", str(database), "--out", str(out)]
    return [*where, "--occlusion", "none", "--workers", "1", "--device", "cpu", *more]


# --- what is left of a map


def test_tracks_without_some_photographs_are_those_of_the_others(tmp_path):
    sparse, _ = write_corridor(tmp_path, noise_px=0.0)
    whole = read_model(sparse)
    before = model_arrays(whole)
    removed = [3, 4, 5]
    rest = model_arrays(without(whole, removed))
    assert (model_arrays(whole).observation_image == before.observation_image).all()  # the whole map stays as it was
    point = np.repeat(before.point_ids, np.diff(before.observation_start))
    kept = ~np.isin(before.image_ids[before.observation_image], removed)
    numbers, counts = np.unique(point[kept], return_counts=True)
    assert rest.point_ids.tolist() == numbers[counts > 1].tolist()
    assert np.diff(rest.observation_start).tolist() == counts[counts > 1].tolist()
    rows = np.searchsorted(before.point_ids, rest.point_ids)
    assert np.abs(rest.points - before.points[rows]).max() < 1e-5  # without noise all observations agree
    assert rest.image_ids.tolist() == before.image_ids[np.isin(before.image_ids, removed, invert=True)].tolist()


def test_landmarks_are_triangulated_without_the_removed_photographs(corridor):
    whole = read_model(corridor[0])
    moved = pycolmap.Reconstruction(whole)
    for number, point in whole.points3D.items():
        moved.points3D[number].xyz = point.xyz + 0.02  # as if photograph 3 had shifted its landmarks
    ids = {point.point3D_id for point in whole.images[3].points2D if point.has_point3D()}
    rest, expected = (without(model, [3]).points3D for model in (moved, whole))
    both = [number for number in ids if number in rest and number in expected]
    assert len(both) > 100
    assert np.quantile([np.linalg.norm(rest[number].xyz - expected[number].xyz) for number in both], 0.9) < 1e-3
    others = [number for number in rest if number not in ids]
    assert all(np.array_equal(rest[number].xyz, moved.points3D[number].xyz) for number in others)


# --- blocks


def test_blocks_share_out_all_photographs_and_grow(corridor):
    source = open_map(*corridor, frame=FrameOptions(scale=1))
    blocks = choose_blocks(source)
    parts = [block for block in blocks if block.is_part]
    assert len(parts) == 8 and 8 <= len(blocks) <= 12
    assert sorted(np.concatenate([block.held_out for block in parts]).tolist()) == [*range(N)]
    (alone,) = (block for block in parts if np.isin(ALONE, block.held_out).any())  # they share landmarks
    assert np.isin(ALONE, alone.held_out).all()
    sees = observation_matrix(source.arrays, source.rig_frame)
    most = int((1 - MIN_REST) * N)
    grown = [block for block in blocks if not block.is_part]
    assert grown and max(len(block.held_out) for block in grown) <= most
    for block in grown:
        kept = np.quantile(landmarks_kept(sees, source.rig_frame[block.held_out]), 0.25)
        assert kept <= KEPT[0] or len(block.held_out) == most
    few = choose_blocks(source, views=3)
    assert max(len(block.tested) for block in few) == 3
    assert all(np.isin(block.tested, block.held_out).all() for block in few)


def test_a_block_without_which_rays_hardly_meet_is_dropped_and_said(tmp_path, monkeypatch):
    """A video that stands still: 20 photographs within 4 cm of a wall 2 m away, and 10 that give the landmarks depth."""
    along = np.concatenate([0.002 * np.arange(20), 0.3 * np.arange(1, 11)])
    centers = np.column_stack([along, np.zeros(N), np.full(N, 1.5)])
    poses = poses_looking_along(centers, np.tile((0.0, 1.0, 0.0), (N, 1)))
    monkeypatch.setattr("holdout.corridor.corridor_poses", lambda: poses)
    source = open_map(*write_corridor(tmp_path), frame=FrameOptions(scale=1))
    groups = [np.arange(20, 30), np.arange(5), np.arange(5, 10)]
    blocks = [Block(number, rows, rows[:2], True) for number, rows in enumerate(groups, 1)]
    with pytest.warns(MapWarning, match=r"10 photographs \(020.jpg to 029.jpg\)"):
        results = hold_out_blocks(source, tmp_path / "work", blocks)
    assert [one.block.number for one in results] == [2, 3]
    with pytest.raises(MapError, match="landmarks are left"), pytest.warns(MapWarning):
        hold_out_blocks(source, tmp_path / "work", blocks[:2])


def test_features_of_other_keypoints_give_way_to_photographs(corridor, tmp_path):
    sparse, database = corridor
    shutil.copytree(sparse, tmp_path / "dense" / "sparse")
    shutil.copy(database, tmp_path / "database.db")
    assert find_source(tmp_path / "dense" / "sparse") == (tmp_path / "database.db", None)
    (tmp_path / "dense" / "images").mkdir()
    (tmp_path / "dense" / "images" / "000.jpg").touch()
    assert find_source(tmp_path / "dense" / "sparse") == (tmp_path / "database.db", None)
    write_corridor(tmp_path / "other", noise_px=2.0)[1].rename(tmp_path / "database.db")
    assert find_source(tmp_path / "dense" / "sparse") == (None, tmp_path / "dense" / "images")


# --- the command


def test_photographs_localize_where_the_rest_maps_what_they_show(checked):
    table = pd.read_csv(checked / "check.csv")
    blocks = pd.read_csv(checked / "blocks.csv")
    assert table["photograph"].tolist() == [f"{row:03}.jpg" for row in range(N)]
    assert np.abs(table[["x", "y", "z"]] - camera_centers(corridor_poses())).to_numpy().max() < 1e-4
    assert np.abs(table[["look_x", "look_y", "look_z"]] - corridor_poses()[:, 2, :3]).to_numpy().max() < 1e-4
    good = table["localized"] == 1
    assert good.sum() >= 20 and not good[[*ALONE]].any() and table.loc[good, "error"].median() < 0.01
    assert (table.loc[[*ALONE], "n_kept"] == 0).all() and (table.loc[[*ALONE], "n_observed"] > 100).all()
    views = pd.read_csv(checked / "views.csv")
    assert views.groupby("block").size().tolist() == blocks["looked_at"].tolist()
    assert views["score"].between(0, 1).all() and {"bins", "visible", "expected_inliers"} <= {*views}
    auc = json.loads((checked / "check.json").read_text())["methods"]["set"]["auc"]
    assert 0.9 < auc["value"] <= 1 and auc["low"] <= auc["value"] <= auc["high"]
    assert (checked / "check.png").is_file()


def test_the_part_that_nothing_else_shows_is_named(checked):
    parts = json.loads((checked / "check.json").read_text())["weak_parts"]
    (part,) = (part for part in parts if "027.jpg" in part["photographs"])
    assert {f"{row:03}.jpg" for row in ALONE} == {*part["photographs"]}
    assert part["center"] == pytest.approx((6.5, 0, 1.5), abs=0.01)
    assert part["target"] == pytest.approx((6.5, -2.5, 1.5), abs=0.4)
    table = pd.read_csv(checked / "check.csv")
    assert (table.loc[[*ALONE], "part"] == part["number"]).all()


@pytest.mark.slow
def test_adapted_weights_are_checked_on_their_own_map_alone(checked, corridor, tmp_path):
    source = open_map(*corridor, frame=FrameOptions(scale=1))
    base = TrainedNetwork.load(WEIGHTS / "set.safetensors", SetNetwork, "set")
    base = for_map(base, whole_map(source, HiddenPointRemoval(), "cpu"))  # as `adapt` writes it
    assert base.of_map is not None
    network = AdaptedNetwork(base.network, base.scale, base.offset, 256, base.of_map.error_scale)  # changes no score
    points = np.array([point.xyz for _, point in sorted(read_model(corridor[0]).points3D.items())])
    path = tmp_path / "adapted.safetensors"
    arguments = [*_arguments(*corridor, tmp_path / "out", "--scale", "1"), "--weights", str(path)]
    for offset_m in (0.0, 0.5):
        network.place = torch.from_numpy(points[:: len(points) // 256][:256] + offset_m)
        TrainedNetwork("adapted", network, base.camera, 1.0, 0.0, base.training_range).save(path, {"scene": "corridor"})
        if offset_m:
            with pytest.raises(WeightsError):
                run(arguments)
            run([*arguments, "--anywhere"])
        else:
            run(arguments)
            same, before = (pd.read_csv(folder / "views.csv")["score"] for folder in (tmp_path / "out", checked))
            assert np.abs(same - before).max() < 1e-6


@pytest.mark.slow
def test_a_map_of_any_scale_and_frame_gives_the_same(corridor, tmp_path):
    turned = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # y is down, as COLMAP leaves it
    tables = []
    for name, files in (("own", corridor), ("other", write_corridor(tmp_path, scale=0.01, rotation=turned))):
        run(_arguments(*files, tmp_path / f"out-{name}"))
        tables.append(pd.read_csv(tmp_path / f"out-{name}" / "check.csv"))
    own, other = tables
    assert own["localized"].sum() >= 20 and (own["localized"] == other["localized"]).all()
    assert np.abs(own["score"] - other["score"]).max() < 0.02
    centers = 0.01 * camera_centers(corridor_poses()) @ turned.T
    assert np.abs(other[["x", "y", "z"]] - centers).to_numpy().max() < 1e-5
    assert other["error"].median() == pytest.approx(0.01 * own["error"].median(), rel=0.2)
    # limits are 1 % of the median depth of the landmarks, 2.5 m
    assert own["limit"].median() == pytest.approx(0.025, rel=0.1)


def test_finished_blocks_are_reused(checked, corridor, tmp_path):
    shutil.copytree(checked, tmp_path / "out")
    (work,) = (tmp_path / "out" / "work").glob("blocks-*")
    (work / "02" / "views.json").unlink()
    (work / "03" / "landmarks.npz").write_bytes(b"half a file")
    cached = (work / "01" / "views.json").stat().st_mtime_ns
    run(_arguments(*corridor, tmp_path / "out", "--scale", "1", "--also", "bins"))
    for name in ("check.csv", "blocks.csv", "views.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (checked / name).read_bytes(), name
    assert (work / "01" / "views.json").stat().st_mtime_ns == cached


def test_another_accuracy_judges_the_same_poses(checked, corridor, tmp_path):
    shutil.copytree(checked, tmp_path / "out")
    (work,) = (tmp_path / "out" / "work").glob("blocks-*")
    before = [path.stat().st_mtime_ns for path in sorted(work.glob("*/views.json"))]
    run(_arguments(*corridor, tmp_path / "out", "--scale", "1", "--accuracy", "0.002,0.1"))
    assert [path.stat().st_mtime_ns for path in sorted(work.glob("*/views.json"))] == before
    own, fine = (pd.read_csv(folder / "views.csv") for folder in (checked, tmp_path / "out"))
    within = (own["status"] == "localized") & (own["error_m"] < 0.002) & (own["error_deg"] < 0.1)
    assert fine["good"].tolist() == within.tolist() and 0 < within.sum() < own["good"].sum()
    assert (fine["score"] <= own["score"]).all() and (fine["limit_m"] == 0.002).all()
    numbers = json.loads((tmp_path / "out" / "check.json").read_text())
    assert numbers["limits"] == "0.2 cm and 0.1 degrees" and numbers["ece"] is not None


@pytest.mark.parametrize(
    ("auc", "ece", "ratio", "in_range", "expected"),
    [
        (0.95, 0.03, 1.1, 1.0, "trust the scores"),
        (0.95, 0.09, 1.1, 1.0, "trust the scores"),  # as exact probabilities of as many views may have
        (0.95, 0.15, 1.1, 1.0, "trust the order"),
        (0.95, 0.03, 6.3, 1.0, "trust the order"),
        (0.95, None, 1.1, 1.0, "trust the order"),  # of a rule that predicts no probabilities
        (0.60, 0.03, 1.1, 1.0, "do not use"),
        (0.95, 0.03, 1.1, 0.3, "do not use"),
        (None, None, 1.1, 1.0, "unknown"),
    ],
)
def test_the_advice_follows_from_order_values_and_range(auc, ece, ratio, in_range, expected):
    numbers = {
        "methods": {"set": {"auc": {"value": auc}}},
        "ece": None if ece is None else {"value": ece},
        "ece_if_calibrated": 0.1,
        "errors_at_right_place": {"m": {"ratio": {"value": ratio}}},
        "share_in_range": in_range,
    }
    none = None
    advice = CheckReport(none, "set", none, none, none, numbers, []).advice()
    assert advice.startswith(expected) or advice.endswith(expected)


def test_narrower_views_of_photographs(corridor, checked, tmp_path):
    """Three views of each photograph, fewer of which localize; the table of photographs has the middle ones."""
    run(_arguments(*corridor, tmp_path / "out", "--scale", "1", "--fov", "25"))
    whole, narrow = (pd.read_csv(folder / "views.csv") for folder in (checked, tmp_path / "out"))
    assert len(narrow) == 3 * len(whole) and set(narrow["crop"]) == {0, 1, 2}
    assert narrow["good"].mean() < whole["good"].mean() and narrow["good"].any()
    each = narrow.groupby(["block", "row"])["n_observed"].max().to_numpy()
    assert (each <= whole.sort_values(["block", "row"])["n_observed"]).all()
    assert len(pd.read_csv(tmp_path / "out" / "check.csv")) == N
    wide = _arguments(*corridor, tmp_path / "wide", "--scale", "1", "--fov", "150")
    with pytest.raises(ConfigError, match="do not show more"):
        run(wide)


def test_eight_photographs_are_enough(tmp_path):
    run(_arguments(*write_corridor(tmp_path / "few", photographs=8), tmp_path / "out", "--scale", "1"))
    numbers = json.loads((tmp_path / "out" / "check.json").read_text())
    assert numbers["n_photographs"] == 8 and numbers["n_blocks"] >= 2 and numbers["ece"]["low"] >= 0


# --- invalid input


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "options, error",
    [
        ([], ConfigError),
        (["--map", "{sparse}", "--scale", "0"], ConfigError),
        (["--map", "{sparse}", "--database", "{database}", "--accuracy", "0,1"], ConfigError),
        (["--map", "{folder}/alone"], MapError),  # no database
        (["--map", "{folder}/nowhere"], MapError),
        (["--map", "{folder}/few/sparse", "--database", "{folder}/few/features.db"], MapError),
        (["--map", "{sparse}", "--database", "{folder}/other/features.db"], MapError),
        (["--map", "{sparse}", "--database", "{database}", "--weights", "{folder}/none"], WeightsError),
    ],
)
def test_invalid_input(options, error, corridor, tmp_path):
    sparse, database = corridor
    shutil.copytree(sparse, tmp_path / "alone")
    write_corridor(tmp_path / "few", photographs=7)
    write_corridor(tmp_path / "other", noise_px=2.0)
    named = [option.format(sparse=sparse, database=database, folder=tmp_path) for option in options]
    with pytest.raises(error):
        run([*named, "--out", str(tmp_path / "out"), "--workers", "1", "--device", "cpu"])


@pytest.mark.slow
def test_photographs_without_features_are_extracted_again(tmp_path):
    write_rendered_room(tmp_path)
    arguments = ["--map", str(tmp_path / "sparse"), "--images", str(tmp_path / "photographs")]
    arguments += ["--scale", "1", "--workers", "1"]
    run([*arguments, "--out", str(tmp_path / "out"), "--views", "8"])
    table = pd.read_csv(tmp_path / "out" / "check.csv")
    assert table["localized"].sum() >= 12 and table["n_observed"].median() > 50
    database = tmp_path / "out" / "work" / "map" / "database.db"
    made = database.stat().st_mtime_ns
    run([*arguments, "--out", str(tmp_path / "out"), "--views", "8"])
    assert database.stat().st_mtime_ns == made
