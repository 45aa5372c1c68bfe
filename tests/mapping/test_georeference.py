"""Georeferencing: closed forms, tables and invalid inputs."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from mapping.marker_rooms import CAMERA, MARKERS, hand_held_poses, marker_room
from wheretolook.commands.map import BuildMap
from wheretolook.geometry.camera import CameraConfig
from wheretolook.geometry.poses import transform
from wheretolook.mapping.config import FrameOptions, ImportConfig, MapConfig, MarkerConfig, PhotographsConfig
from wheretolook.mapping.georeference import (
    MapScale,
    Marker,
    MarkerView,
    detect_markers,
    fit_similarity,
    place_marker,
    read_marker_table,
    read_positions,
    scale_from_distance,
    scale_from_markers,
    scale_from_positions,
)
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.utils.errors import ConfigError, MapError, TableError

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)


def square(marker_id, side):
    return Marker(marker_id, SQUARE * side + marker_id, ("a.jpg", "b.jpg"), 0.1)


def by_photograph(n):
    points = np.random.default_rng(3).normal(size=(n, 3))
    return {f"{index}.jpg": point for index, point in enumerate(points)}


def test_similarity_is_recovered_and_never_mirrors():
    points = np.random.default_rng(0).normal(size=(10, 3))
    rotation = Rotation.random(random_state=1).as_matrix()
    similarity = fit_similarity(points, 3.7 * points @ rotation.T + (1, -2, 5))
    assert similarity.scale == pytest.approx(3.7)
    assert_allclose(similarity.rotation, rotation, atol=1e-12)
    assert_allclose(similarity.translation, (1, -2, 5), atol=1e-12)
    assert np.linalg.det(fit_similarity(points, points * (1, 1, -1)).rotation) == pytest.approx(1)
    line = np.arange(5.0)[:, None] * (1, 2, 3)
    for few in (np.eye(3)[:2], line):
        with pytest.raises(MapError):
            fit_similarity(few, few)


def test_scale_is_the_median_over_the_sides_of_markers():
    often = Marker(3, SQUARE * 0.49, ("a.jpg", "b.jpg", "c.jpg"), 0.3)
    scale = scale_from_markers([square(1, 0.5), square(2, 0.51), often], 0.2)
    assert scale.source == "markers" and scale.is_metric and scale.unit == "percent"
    assert scale.factor == pytest.approx(0.4)
    assert scale.residuals["marker 2 side 0"] == pytest.approx(2.0) and len(scale.residuals) == 12
    assert scale.marker_error_px == {"marker 1": 0.1, "marker 2": 0.1, "marker 3": 0.3}
    assert scale.marker_views == {"marker 1": 2, "marker 2": 2, "marker 3": 3}
    assert "NOT CHECKED" not in scale.describe()
    assert "NOT CHECKED" in scale_from_markers([square(1, 1.0)], 0.2).describe()
    markers = [square(1, 0.5), square(2, 0.5), square(3, 1.0)]
    assert scale_from_markers(markers, {1: 0.2, 2: 0.2, 3: 0.4}).factor == pytest.approx(0.4)
    stretched = Marker(4, SQUARE * (1.0, 1.2, 1.0), ("a.jpg", "b.jpg"), 0.1)
    for wrong in (markers, [stretched], []):
        with pytest.raises(MapError):
            scale_from_markers(wrong, 0.2)


def test_scale_from_a_distance():
    assert scale_from_distance((0, 0, 0), (0, 3, 4), 2.5) == MapScale("distance", 0.5)
    with pytest.raises(MapError):
        scale_from_distance((1, 1, 1), (1, 1, 1), 2.5)


def test_positions_determine_the_frame_and_leave_residuals():
    centers = by_photograph(6)
    rotation = Rotation.random(random_state=4).as_matrix()
    positions = {name: 2 * rotation @ center + (5, 0, 1) for name, center in centers.items()}
    scale, similarity = scale_from_positions(centers, {**positions, "lost.jpg": np.zeros(3)})
    assert scale.factor == pytest.approx(2) and scale.unit == "m" and list(scale.unused) == ["lost.jpg"]
    assert max(scale.residuals.values()) < 1e-12 and set(scale.residuals) == set(centers)
    assert_allclose(similarity.apply(centers["3.jpg"]), positions["3.jpg"])
    positions["2.jpg"] = positions["2.jpg"] + (0, 0, 0.3)
    worst = scale_from_positions(centers, positions)[0].residuals
    assert max(worst, key=lambda name: worst[name]) == "2.jpg"


def test_positions_that_do_not_fit_are_rejected_worst_first():
    centers = by_photograph(14)
    for off_m in (2.0, 100.0):
        positions = {name: 2 * center for name, center in centers.items()}
        positions["2.jpg"] = positions["2.jpg"] + (0, off_m, 0)
        with pytest.raises(MapError) as caught:
            scale_from_positions(centers, positions)
        assert str(caught.value.value).startswith("2.jpg: ")
    with pytest.raises(MapError):
        scale_from_positions(centers, dict(zip(centers, reversed(centers.values()), strict=True)))


def test_tables_of_markers_and_positions_are_read(tmp_path):
    table = tmp_path / "markers.csv"
    table.write_text("id, size_m\n3, 0.4\n7, 0.2\n7, 0.2\n")
    assert read_marker_table(table) == {3: 0.4, 7: 0.2}
    for text in (
        "image,x,y,z\na.jpg,1.5,2,3\n",
        '{"a.jpg": [1.5, 2, 3]}',
        "a.jpg 1.5 2 3\n",  # COLMAP's
        "#Label,X/Easting,Y/Northing,Z/Altitude,Yaw\na.jpg,1.5,2,3,0\n# <label,x,y,z>\n",  # Agisoft's
        "Label\tX [m]\tY [m]\tZ [m]\na.jpg\t1.5\t2\t3\n",
        "image;x;y;z\na.jpg;1,5;2,0;3\n",
        "1 1 0 0 0 -1.5 -2 -3 1 a.jpg\n",
    ):
        (tmp_path / "p").write_text(text)
        assert_array_equal(read_positions(str(tmp_path / "p"))["a.jpg"], (1.5, 2, 3))
    (tmp_path / "p").write_text("image;x;y;z\na,b.jpg;1,5;2,0;3\n")
    assert [*read_positions(tmp_path / "p")] == ["a,b.jpg"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        *[("m.csv", f"id,size_m\n{rows}") for rows in ("3,0.4\n3,0.2\n", "", "x,0.4\n", "3,-1\n", "3\n")],
        ("m.csv", "id,width\n3,0.4\n"),
        ("p.csv", "image,x,y,z\na.jpg,1,2,3\na.jpg,1,2,4\n"),
        ("p.csv", "x,y,z\n1,2,3\n"),
        ("p.csv", "label,x/longitude,y/latitude,z/altitude\na.jpg,11.5,48.1,500\n"),
        *[("p.json", text) for text in ('{"a.jpg": [1, 2]}', '{"a.jpg": "x"}', "[1]", "{")],
        ("p.json", '{"a.jpg": [1, 2, 3], "a.jpg": [1, 2, 4]}'),
        ("p.csv", None),
    ],
)
def test_invalid_tables_are_rejected(tmp_path, name, text):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(TableError):
        (read_marker_table if name[0] == "m" else read_positions)(tmp_path / name)


def test_invalid_settings_are_rejected():
    known = FrameOptions(distance=("a.jpg", "marker:7", 1.5))
    assert known.marker_ids == ["7"]
    for ends in (("a.jpg", "a.jpg"), ("a.jpg", "marker:x")):
        with pytest.raises(ConfigError):
            FrameOptions(distance=(*ends, 1.0))
    for settings in ({"marker_size_m": 0.2, "marker_table": Path("m.csv")}, {"marker_size_m": -1.0}):
        with pytest.raises(ConfigError):
            MarkerConfig(**settings)
    sized = MarkerConfig(marker_size_m=0.2)
    with pytest.raises(ConfigError):
        PhotographsConfig(Path("photos"), scale=sized, frame=known)
    with pytest.raises(ConfigError):
        PhotographsConfig(Path("photos"), frame=FrameOptions(scale=2))
    with pytest.raises(ConfigError):
        ImportConfig(model=Path("model"), scale=sized, frame=FrameOptions(scale=2))
    with pytest.raises(ConfigError):
        BuildMap(up="level")


@pytest.mark.parametrize("source", [{"photographs": PhotographsConfig(Path("photos"))}, {"model": Path("model")}])
def test_options_of_renders_are_rejected_by_name_for_other_maps(source):
    of_renders = {"camera": CameraConfig(), "draw_camera": True, "vary": True, "appearance": 0.4, "keep_images": True}
    BuildMap(**source, mapping=MapConfig(keep_database=True))
    for name, value in of_renders.items():
        BuildMap(mapping=MapConfig(**{name: value}))
        with pytest.raises(ConfigError, match=rf"photographs or a model.*'mapping\.{name}'"):
            BuildMap(**source, mapping=MapConfig(**{name: value}))


def test_a_mislabelled_position_of_many_is_left_out(rng, caplog):
    centers = {f"{n:02}.jpg": rng.normal(0, 2, 3) for n in range(30)}
    positions = {name: 3 * center + (1, 2, 3) for name, center in centers.items()}
    positions["07.jpg"] = positions["07.jpg"] + (9, -7, 0)
    scale, similarity = scale_from_positions(centers, positions)
    assert similarity.scale == pytest.approx(3) and "07.jpg" not in scale.residuals
    assert "m off" in scale.unused["07.jpg"] and "07.jpg" in caplog.text
    for n in range(8, 12):  # more than one in twenty
        positions[f"{n:02}.jpg"] = positions[f"{n:02}.jpg"] + (0, 9, 5)
    with pytest.raises(MapError, match="do not fit"):
        scale_from_positions(centers, positions)
    with pytest.raises(MapError, match=r"x.png; images are named like 00.jpg"):
        scale_from_positions(centers, {"x.png": np.zeros(3)})


# Markers in images and in the map.

COLMAP_CAMERA = pycolmap.Camera(
    model="SIMPLE_RADIAL",
    width=CAMERA.width,
    height=CAMERA.height,
    params=[CAMERA.focal_px, CAMERA.cx, CAMERA.cy, 0.05],
)
MARKER = MARKERS[1]


def view(name, pose, noise_px=0.0):
    """What a camera sees of `MARKER`, by COLMAP's own projection."""
    pixels = np.asarray(COLMAP_CAMERA.img_from_cam(transform(pose, MARKER.corners)))
    noise = np.random.default_rng(len(name)).normal(scale=noise_px, size=(4, 2)) if noise_px else 0.0
    return MarkerView(name, COLMAP_CAMERA, pose, pixels + noise)


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_APRILTAG_36H11"])
def test_rendered_corners_are_found_to_a_tenth_of_a_pixel(dictionary):
    pose = hand_held_poses()[[7, 8]]
    for rgb, at in zip(WarpRenderer(marker_room(dictionary=dictionary)).render(CAMERA, pose).rgb, pose, strict=True):
        found = detect_markers(rgb, dictionary)
        assert set(found) == {3, 7, 11}
        for marker in MARKERS:
            expected = CAMERA.project(transform(at, marker.corners))
            assert np.linalg.norm(found[marker.marker_id] - expected, axis=1).max() < 0.1


def test_corners_meet_where_they_are():
    views = [view(f"{index}.jpg", pose) for index, pose in enumerate(hand_held_poses()[4:9])]
    marker = place_marker(7, views)
    assert_allclose(marker.corners, MARKER.corners, atol=1e-6)
    assert_allclose(marker.sides, MARKER.size_m, atol=1e-6)
    assert_allclose(marker.center, MARKER.center, atol=1e-6)
    assert marker.images == tuple(f"{index}.jpg" for index in range(5)) and marker.error_px < 1e-4


def test_one_bad_view_moves_little():
    views = [view(f"{index}.jpg", pose) for index, pose in enumerate(hand_held_poses()[3:11])]
    off = MarkerView("off.jpg", COLMAP_CAMERA, views[2].cam_from_world, views[2].corners_px + np.array([8.0, 0.0]))
    marker = place_marker(7, [*views, off])
    assert_allclose(marker.corners, MARKER.corners, atol=0.01)


def test_a_marker_in_two_places_is_refused():
    """One id printed twice, 0.4 m apart, seen in three photographs."""
    views = [view(f"{index}.jpg", pose) for index, pose in enumerate(hand_held_poses()[[4, 6, 8]])]
    elsewhere = MARKER.corners + np.array([0.4, 0.0, 0.0])
    pixels = np.asarray(COLMAP_CAMERA.img_from_cam(transform(views[1].cam_from_world, elsewhere)))
    moved = MarkerView("1.jpg", COLMAP_CAMERA, views[1].cam_from_world, pixels)
    assert place_marker(7, views).error_px < 1e-4
    with pytest.raises(MapError):
        place_marker(7, [views[0], moved, views[2]])


def test_the_same_marker_twice_in_an_image_is_refused():
    kind = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    one = np.pad(cv2.aruco.generateImageMarker(kind, 5, 90), 30, constant_values=255)
    rgb = np.repeat(np.hstack([one, one])[..., None], 3, axis=2)
    with pytest.raises(MapError):
        detect_markers(rgb, "DICT_4X4_50")
    assert set(detect_markers(rgb[:, :150], "DICT_4X4_50")) == {5}
