"""Masks for Nav2, read back by the rules that its map_server documents."""

from pathlib import Path

import numpy as np
import pandas as pd
import PIL.Image
import pytest
import yaml

from planning.rooms import TURNED, room_landmarks, write_room_dataset
from selection.room import WEIGHTS, write_room
from wheretolook.cli import main
from wheretolook.planning.nav2 import places_at_height, write_mask
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.utils.errors import SceneError


def read_mask(path):
    """Return the values of an OccupancyGrid by the centres of its cells in metres, and the width of a cell."""
    about = yaml.safe_load(path.read_text())
    with PIL.Image.open(path.parent / about["image"]) as image:
        assert (image.format, image.mode) == ("PPM", "L")
        pixels = np.asarray(image)
    shade = pixels / 255
    occupied = shade if about["negate"] else 1 - shade
    high, low = about["occupied_thresh"], about["free_thresh"]
    assert 0 <= low < high <= 1  # map_server refuses others
    between = {"trinary": -1.0, "scale": np.rint((occupied - low) / (high - low) * 100), "raw": 0}[about["mode"]]
    values = np.select([occupied > high, occupied < low], [100.0, 0.0], between)
    if about["mode"] == "raw":  # without negate and thresholds
        values = np.where(pixels <= 100, pixels, -1.0)
    x, y, yaw = about["origin"]  # the lower left corner of the lower left cell; the image's first row is the upper one
    assert yaw == 0
    size = about["resolution"]
    height, width = values.shape
    centers = {}
    for row in range(height):
        for column in range(width):
            at = (x + (column + 0.5) * size, y + (height - row - 0.5) * size)
            centers[at] = int(values[row, column])
    return centers, size


def check_values(folder, expected):
    """Compare the masks cell by cell with the best probability at a point, None where no place is."""
    costs, size = read_mask(folder / "costs.yaml")
    limits, _ = read_mask(folder / "mask.yaml")
    closed, _ = read_mask(folder / "keepout.yaml")
    known = 0
    for (x, y), cost in costs.items():
        probability = expected(x, y)
        if probability is None:
            assert (cost, limits[x, y], closed[x, y]) == (-1, 0, -1)
        else:
            assert cost == limits[x, y] and 0 <= cost <= 99 and abs(cost - 100 * (1 - probability)) <= 1
            assert closed[x, y] == (100 if probability < 0.5 else -1) or abs(probability - 0.5) < 0.003
            known += 1
    return known, size


def test_a_viewpoint_map_is_read_back_cell_by_cell(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_room_dataset(tmp_path, room_landmarks(200), names="a")
    options = ["--name", "rooms", "--data", str(tmp_path / "data"), "--camera.focal_px", "80", "--camera.width", "160"]
    options += ["--camera.height", "120", "--device", "cpu", "--grid", "5", "4", "3", "--directions", "12"]
    given = ["--scene", "a", "--out", "a.map", "--nav2", "masks", "--camera-z", "1.2"]
    assert main(["viewpoint-map", *options, *given]) == 0
    viewpoint_map = ViewpointMap.load("a.map")

    def best(x, y):
        choice = viewpoint_map.best((x, y, 1.2))
        return None if choice is None else choice.score

    known, size = check_values(Path("masks"), best)
    assert known > 10 and size == viewpoint_map.grid.voxel_m[:2].min()
    places, probability, _ = places_at_height(viewpoint_map.in_frame(TURNED), 1.2)  # the world is the same
    write_mask(Path("turned"), places, probability, size)
    assert Path("turned/mask.pgm").read_bytes() == Path("masks/mask.pgm").read_bytes()
    assert main(["viewpoint-map", *options, "--scene", "a", "--camera-z", "1"]) == 2
    places, probability, _ = places_at_height(viewpoint_map, 9.0)  # above the room
    with pytest.raises(SceneError, match=r"got 9\.0\)"):
        write_mask(Path("above"), places, probability, size)


def test_a_grid_is_read_back_cell_by_cell(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_room(tmp_path / "sparse")
    write_room(tmp_path / "unknown", metric=False)
    options = ["--directions", "60", "--device", "cpu", "--out", "views.csv"]
    given = ["select", "--map", "sparse", "--grid", "0.5", "--weights", str(WEIGHTS), *options]
    for _ in range(2):  # masks may be replaced
        assert main([*given, "--camera-z", "1.25", "--nav2", "masks"]) == 0
    views = pd.read_csv("views.csv")
    assert (views["z"] == 1.25).all()
    places = views[["x", "y"]].to_numpy()

    def best(x, y):
        off = np.linalg.norm(places - (x, y), axis=1)
        return views["score"][off.argmin()] if off.min() < 1e-6 else None

    assert check_values(Path("masks"), best) == (len(views), 0.5)
    Path("other").mkdir()
    Path("other/notes.txt").write_text("keep")
    for wrong, message in (
        ([*given, "--nav2", "new"], "needs the height"),
        (
            [
                "select",
                "--map",
                "sparse",
                "--grid",
                "1",
                *options,
                "--camera-z",
                "1",
                "--nav2",
                "new",
                "--method",
                "visible",
            ],
            "probabilities",
        ),
        ([*given, "--camera-z", "100", "--nav2", "other"], "something else"),
        ([*given, "--camera-z", "1", "--nav2", "new", "--looks", "2"], "--looks"),
        ([*given, "--camera-z", "1", "--nav2", "new", "--max-turn", "0"], "--max-turn"),
        ([*given, "--camera-z", "100"], "--camera-z is outside the map, whose z is "),
        (["select", "--map", "unknown", "--grid", "1", *options, "--camera-z", "1"], "metres"),
        (["select", "--map", "sparse", "--at", "2,2,1", *options, "--camera-z", "0"], "need --grid"),
        (["select", "--map", "sparse", "--at", "2,2,1", *options, "--camera-z", "1", "--nav2", "new"], "--grid"),
        (["select", "--map", "unknown", "--grid", "1", *options, "--camera-z", "0", "--nav2", "new"], "metres"),
    ):
        assert main(wrong) == 2 and message in capsys.readouterr().err
    assert not Path("new").exists()


@pytest.mark.parametrize("probability", [0.0, 0.004, 0.5, 0.999, 1.0])
def test_no_place_is_lethal_and_none_is_unscored(tmp_path, probability):
    write_mask(
        tmp_path / "m",
        np.array([(0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (1.0, 1.0, 1.0)]),
        np.array([probability, 1, np.nan]),
        1.0,
    )
    for name in ("mask", "costs"):
        costs, _ = read_mask(tmp_path / "m" / f"{name}.yaml")
        assert costs == {(0.0, 0.0): min(99, round(100 * (1 - probability))), (0.0, 1.0): 0}


def test_the_parameters_of_the_page_name_what_is_written(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "nav2.md").read_text()
    nodes = yaml.safe_load(page.partition("```yaml\n")[2].partition("```")[0])
    places = np.array([(0.0, 0.0, 1.0), (1.0, 1.0, 1.0)])
    write_mask(tmp_path / "masks", places, np.zeros(2), 1.0)
    topics = set()
    for name, no_view in (("filter_mask_server", -1), ("speed_mask_server", 0)):  # which the SpeedFilter rejects: -1
        served = nodes[name]["ros__parameters"]
        assert read_mask(tmp_path / served["yaml_filename"])[0][0.0, 1.0] == no_view
        topics.add(served["topic_name"])
    infos = [nodes[f"{name}_filter_info_server"]["ros__parameters"] for name in ("costmap", "speed")]
    assert {info["mask_topic"] for info in infos} == topics
    filters = nodes["global_costmap"]["global_costmap"]["ros__parameters"]
    used = [filters[name]["filter_info_topic"] for name in filters["filters"]]
    assert used == [info["filter_info_topic"] for info in infos]
    worst = infos[1]["base"] + infos[1]["multiplier"] * 99
    assert round(worst) == 11  # percent of the greatest speed: 0 would be no limit
