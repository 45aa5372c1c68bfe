"""`wheretolook check` on a corridor whose photographs, landmarks and descriptors are known."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

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
from wheretolook.geometry.poses import camera_centers
from wheretolook.holdout.holdout import without
from wheretolook.holdout.holdout_blocks import KEPT, MIN_REST, choose_blocks, landmarks_kept, observation_matrix
from wheretolook.holdout.photo_map import open_map
from wheretolook.mapping.colmap_model import model_arrays, read_model
from wheretolook.scorers.adapted.network import AdaptedNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import ConfigError, MapError, WeightsError


def run(arguments: list[str]) -> None:
    parse_command("check", arguments).run()


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_corridor(tmp_path_factory.mktemp("corridor"))


@pytest.fixture(scope="module")
def checked(corridor: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("checked") / "out"
    run(_arguments(*corridor, out, "--metres", "--also", "bins"))
    return out


def _arguments(sparse: Path, database: Path, out: Path, *more: str) -> list[str]:
    where = ["--map", str(sparse), "--database", str(database), "--out", str(out)]
    return [*where, "--occlusion", "none", "--workers", "1", "--device", "cpu", *more]


# --- what is left of a map


def test_tracks_without_some_photographs_are_those_of_the_others(tmp_path: Path) -> None:
    sparse, _ = write_corridor(tmp_path, noise_px=0.0)
    whole = read_model(sparse)
    before = model_arrays(whole)
    left_out = [3, 4, 5]
    rest = model_arrays(without(whole, left_out))
    assert (model_arrays(whole).observation_image == before.observation_image).all()  # the whole map stays as it was
    point = np.repeat(before.point_ids, np.diff(before.observation_start))
    kept = ~np.isin(before.image_ids[before.observation_image], left_out)
    numbers, counts = np.unique(point[kept], return_counts=True)
    assert rest.point_ids.tolist() == numbers[counts > 1].tolist()
    assert np.diff(rest.observation_start).tolist() == counts[counts > 1].tolist()
    # without noise every observation tells of the same place
    rows = np.searchsorted(before.point_ids, rest.point_ids)
    assert np.abs(rest.points - before.points[rows]).max() < 1e-5
    others = np.isin(before.image_ids, left_out, invert=True)
    assert rest.image_ids.tolist() == before.image_ids[others].tolist()
    assert np.array_equal(rest.image_centers, before.image_centers[others])


def test_landmarks_forget_what_the_photographs_left_out_have_told(corridor: tuple[Path, Path]) -> None:
    whole = read_model(corridor[0])
    moved = pycolmap.Reconstruction(whole)
    far = {number: point.xyz + 0.02 for number, point in moved.points3D.items()}
    for number, xyz in far.items():
        moved.points3D[number].xyz = xyz  # as if photograph 3 had pulled its landmarks aside
    ids = {point.point3D_id for point in whole.images[3].points2D if point.has_point3D()}
    rest = without(moved, [3])
    true = without(whole, [3])
    lost = [number for number in ids if number in rest.points3D and number in true.points3D]
    assert len(lost) > 100
    off = [np.linalg.norm(rest.points3D[number].xyz - true.points3D[number].xyz) for number in lost]
    assert np.quantile(off, 0.9) < 1e-3
    untouched = [number for number in rest.points3D if number not in ids]
    assert all(np.array_equal(rest.points3D[number].xyz, far[number]) for number in untouched[:50])


# --- blocks


def test_blocks_share_out_all_photographs_and_grow(corridor: tuple[Path, Path]) -> None:
    source = open_map(*corridor, metric=True)
    blocks = choose_blocks(source)
    parts = [block for block in blocks if block.is_part]
    assert 8 <= len(blocks) <= 12 and [block.number for block in blocks] == [*range(1, len(blocks) + 1)]
    assert sorted(np.concatenate([block.held_out for block in parts]).tolist()) == [*range(N)]
    sizes = [len(block.held_out) for block in parts]
    assert len(parts) == 8 and max(sizes) >= 3 * min(sizes)
    sees = observation_matrix(source)
    grown = [block for block in blocks if not block.is_part]
    assert grown and max(len(block.held_out) for block in grown) <= (1 - MIN_REST) * N
    for block in grown:
        worse = np.quantile(landmarks_kept(sees, source.moment[block.held_out]), 0.25)
        assert worse <= KEPT[0] or len(block.held_out) == int((1 - MIN_REST) * N)
    again = choose_blocks(open_map(*corridor, metric=True))
    assert all(np.array_equal(one.held_out, other.held_out) for one, other in zip(blocks, again, strict=True))
    few = choose_blocks(source, views=3)
    assert max(len(block.tested) for block in few) == 3
    assert all(np.isin(block.tested, block.held_out).all() for block in few)


def test_neighbours_are_those_that_share_landmarks_whatever_their_names(tmp_path: Path) -> None:
    sparse, database = write_corridor(tmp_path)
    source = open_map(sparse, database, metric=True)
    alone = [block for block in choose_blocks(source) if block.is_part and np.isin(ALONE, block.held_out).any()]
    assert len(alone) == 1 and np.isin(ALONE, alone[0].held_out).all()


# --- the command


def test_photographs_localize_where_the_rest_knows_what_they_show(checked: Path) -> None:
    table = pd.read_csv(checked / "check.csv")
    blocks = pd.read_csv(checked / "blocks.csv")
    assert table["photograph"].tolist() == [f"{row:03}.jpg" for row in range(N)]
    assert np.abs(table[["x", "y", "z"]] - camera_centers(corridor_poses())).to_numpy().max() < 1e-4
    assert np.abs(table[["look_x", "look_y", "look_z"]] - corridor_poses()[:, 2, :3]).to_numpy().max() < 1e-4
    good = table["localized"] == 1
    assert good.sum() >= 20 and not good[[*ALONE]].any()
    assert (table.loc[good, "error"] < 0.05).all() and table.loc[good, "error"].median() < 0.01
    assert (table.loc[[*ALONE], "n_kept"] == 0).all() and (table.loc[[*ALONE], "n_observed"] > 100).all()
    assert (table["n_inliers"] <= table["n_matches"]).all() and (table["n_kept"] <= table["n_observed"]).all()
    assert (blocks["localized"] <= blocks["looked_at"]).all()
    views = pd.read_csv(checked / "views.csv")
    assert views.groupby("block").size().tolist() == blocks["looked_at"].tolist()
    assert table["times_left_out"].sum() == len(views)
    assert views["score"].between(0, 1).all() and {"bins", "visible", "expected_inliers"} <= {*views}


def test_auc_of_the_checked_method(checked: Path) -> None:
    auc = json.loads((checked / "check.json").read_text())["methods"]["set"]["auc"]
    assert 0.9 < auc["value"] <= 1 and auc["low"] <= auc["value"] <= auc["high"]
    assert (checked / "check.png").is_file()


def test_the_part_that_nothing_else_shows_is_named(checked: Path) -> None:
    content = json.loads((checked / "check.json").read_text())
    named = [part for part in content["weak_parts"] if "027.jpg" in part["photographs"]]
    assert len(named) == 1 and {f"{row:03}.jpg" for row in ALONE} == {*named[0]["photographs"]}
    assert named[0]["center"] == pytest.approx((6.5, 0, 1.5), abs=0.01)
    assert named[0]["target"] == pytest.approx((6.5, -2.5, 1.5), abs=0.4)
    table = pd.read_csv(checked / "check.csv")
    assert (table.loc[[*ALONE], "part"] == named[0]["number"]).all()
    assert (table.loc[table["localized"] == 1, "part"] == 0).all()


def _adapted(folder: Path, place: np.ndarray) -> Path:
    """Weights that are adapted to a place with these landmarks, and change nothing."""
    base = TrainedNetwork.load(WEIGHTS / "set.safetensors", SetNetwork, "set")
    network = AdaptedNetwork(base.network, base.scale, base.offset, 1.0, 4.0, 0, len(place))
    network.place = torch.from_numpy(np.array(place))
    path = folder / "adapted.safetensors"
    TrainedNetwork("adapted", network, base.camera, 1.0, 0.0, base.training_range).save(path, {"scene": "corridor"})
    return path


@pytest.mark.slow
def test_adapted_weights_are_checked_on_their_map_without_most_of_its_landmarks(
    checked: Path, corridor: tuple[Path, Path], tmp_path: Path
) -> None:
    shutil.copytree(checked, tmp_path / "out")
    points = np.array([point.xyz for _, point in sorted(read_model(corridor[0]).points3D.items())])
    place = points[:: len(points) // 256][:256]
    arguments = _arguments(*corridor, tmp_path / "out", "--metres", "--weights")
    run([*arguments, str(_adapted(tmp_path, place))])
    few = pd.read_csv(tmp_path / "out" / "views.csv")["n_landmarks"].min()
    assert few < len(points) / 2  # a map without that many would be taken for another place
    same, before = (pd.read_csv(folder / "views.csv")["score"] for folder in (tmp_path / "out", checked))
    assert np.abs(same - before).max() < 1e-6
    elsewhere = str(_adapted(tmp_path, place + 0.5))
    with pytest.raises(WeightsError, match=r"adapted to another scene.*--anywhere"):
        run([*_arguments(*corridor, tmp_path / "new", "--metres", "--weights"), elsewhere])
    assert not [*(tmp_path / "new").glob("work/*")]  # before the work
    run([*arguments, elsewhere, "--anywhere"])


@pytest.mark.slow
def test_a_map_of_any_scale_and_frame_gives_the_same(
    corridor: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # y is down, as COLMAP leaves it
    found = []
    for name, other in (("own", corridor), ("other", write_corridor(tmp_path, scale=0.01, rotation=turned))):
        run(_arguments(*other, tmp_path / f"out-{name}"))
        found.append(pd.read_csv(tmp_path / f"out-{name}" / "check.csv"))
        assert ("turned upright" in capsys.readouterr().out) == (name == "other")
    own, other = found
    assert own["localized"].sum() >= 20 and (own["localized"] == other["localized"]).all()
    assert np.abs(own["score"] - other["score"]).max() < 0.02
    centers = 0.01 * camera_centers(corridor_poses()) @ turned.T
    assert np.abs(other[["x", "y", "z"]] - centers).to_numpy().max() < 1e-5
    assert other["error"].median() == pytest.approx(0.01 * own["error"].median(), rel=0.2)
    # limits are 1 % of the depth of what is seen, 2.5 m on average
    assert own["limit"].median() == pytest.approx(0.025, rel=0.1)
    content = json.loads((tmp_path / "out-other" / "check.json").read_text())
    assert not content["in_metres"] and "1 % of the median depth" in content["limits"]


def test_finished_blocks_are_reused(checked: Path, corridor: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copytree(checked, tmp_path / "out")
    (work,) = (tmp_path / "out" / "work").glob("blocks-*")
    (work / "02" / "views.parquet").unlink()
    (work / "03" / "landmarks.npz").write_bytes(b"half a file")
    cached = (work / "01" / "views.parquet").stat().st_mtime_ns
    run(_arguments(*corridor, tmp_path / "out", "--metres", "--also", "bins"))
    for name in ("check.csv", "blocks.csv", "views.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (checked / name).read_bytes(), name
    assert (work / "01" / "views.parquet").stat().st_mtime_ns == cached


# --- invalid input


def no_features(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    shutil.copytree(corridor[0], folder / "alone" / "sparse")
    return ["--map", str(folder / "alone" / "sparse")]


def no_model(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    return ["--map", str(folder / "nowhere")]


def no_weights(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    return ["--map", str(corridor[0]), "--database", str(corridor[1]), "--weights", str(folder / "none")]


def too_few_photographs(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    sparse, database = write_corridor(folder, photographs=19)
    return ["--map", str(sparse), "--database", str(database)]


def other_features(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    return ["--map", str(corridor[0]), "--database", str(write_corridor(folder, noise_px=2.0)[1])]


def no_landmarks_without_a_block(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    sparse, database = write_corridor(folder)
    model = read_model(sparse)
    for number in sorted(model.points3D)[:-40]:
        model.delete_point3D(number)
    model.write_binary(str(sparse))
    return ["--map", str(sparse), "--database", str(database)]


def neither_map_nor_scene(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    return []


def mesh_without_metres(corridor: tuple[Path, Path], folder: Path) -> list[str]:
    return ["--map", str(corridor[0]), "--mesh", "scan.glb"]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "make, error",
    [
        (neither_map_nor_scene, ConfigError),
        (mesh_without_metres, ConfigError),
        (no_features, MapError),
        (no_model, MapError),
        (too_few_photographs, MapError),
        (other_features, MapError),
        (no_landmarks_without_a_block, MapError),
        (no_weights, WeightsError),
    ],
)
def test_invalid_input(
    make: Callable[[tuple[Path, Path], Path], list[str]],
    error: type[Exception],
    corridor: tuple[Path, Path],
    tmp_path: Path,
) -> None:
    with pytest.raises(error):
        run([*make(corridor, tmp_path), "--out", str(tmp_path / "out"), "--workers", "1", "--device", "cpu"])


@pytest.mark.slow
def test_photographs_without_features_are_extracted_again(tmp_path: Path) -> None:
    write_rendered_room(tmp_path)
    arguments = ["--map", str(tmp_path / "sparse"), "--images", str(tmp_path / "photographs")]
    arguments += ["--metres", "--workers", "1"]
    run([*arguments, "--out", str(tmp_path / "out"), "--views", "8"])
    table = pd.read_csv(tmp_path / "out" / "check.csv")
    assert table["localized"].sum() >= 12 and table["n_observed"].median() > 50
    database = tmp_path / "out" / "work" / "map" / "database.db"
    made = database.stat().st_mtime_ns
    run([*arguments, "--out", str(tmp_path / "out"), "--views", "8"])
    assert database.stat().st_mtime_ns == made
