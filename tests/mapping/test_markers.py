"""Markers in images and in the map."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest

from mapping.marker_rooms import CAMERA, MARKERS, hand_held_poses, marker_room
from wheretolook.geometry.poses import poses_looking_along, transform
from wheretolook.mapping.markers import MAX_ERROR_PX, MAX_ERROR_SHARE, MarkerView, detect_markers, place_marker
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.utils.errors import ConfigError, MapError

COLMAP_CAMERA = pycolmap.Camera(
    model="SIMPLE_RADIAL",
    width=CAMERA.width,
    height=CAMERA.height,
    params=[CAMERA.focal_px, CAMERA.cx, CAMERA.cy, 0.05],
)
MARKER = MARKERS[1]


def view(name: str, pose: np.ndarray, noise_px: float = 0.0) -> MarkerView:
    """What a camera sees of `MARKER`, by COLMAP's own projection."""
    pixels = np.asarray(COLMAP_CAMERA.img_from_cam(transform(pose, MARKER.corners)))
    noise = np.random.default_rng(len(name)).normal(scale=noise_px, size=(4, 2)) if noise_px else 0.0
    return MarkerView(name, COLMAP_CAMERA, pose, pixels + noise)


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_APRILTAG_36H11"])
def test_rendered_corners_are_found_to_a_tenth_of_a_pixel(dictionary: str) -> None:
    pose = hand_held_poses()[[7, 8]]
    for rgb, at in zip(WarpRenderer(marker_room(dictionary=dictionary)).render(CAMERA, pose).rgb, pose, strict=True):
        found = detect_markers(rgb, dictionary)
        assert set(found) == {3, 7, 11}
        for marker in MARKERS:
            expected = CAMERA.project(transform(at, marker.corners))
            assert np.linalg.norm(found[marker.marker_id] - expected, axis=1).max() < 0.1


def test_corners_meet_where_they_are() -> None:
    views = [view(f"{index}.jpg", pose) for index, pose in enumerate(hand_held_poses()[4:9])]
    marker = place_marker(7, views)
    np.testing.assert_allclose(marker.corners, MARKER.corners, atol=1e-6)
    np.testing.assert_allclose(marker.sides, MARKER.size_m, atol=1e-6)
    np.testing.assert_allclose(marker.center, MARKER.center, atol=1e-6)
    assert marker.images == tuple(f"{index}.jpg" for index in range(5)) and marker.error_px < 1e-4


def test_one_bad_view_moves_little() -> None:
    views = [view(f"{index}.jpg", pose) for index, pose in enumerate(hand_held_poses()[3:11])]
    off = MarkerView("off.jpg", COLMAP_CAMERA, views[2].cam_from_world, views[2].corners_px + np.array([8.0, 0.0]))
    marker = place_marker(7, [*views, off])
    np.testing.assert_allclose(marker.corners, MARKER.corners, atol=0.01)


def test_a_marker_in_two_places_is_refused() -> None:
    """One id printed twice, 0.4 m apart, seen in three photographs."""
    views = [view(f"{index}.jpg", pose) for index, pose in enumerate(hand_held_poses()[[4, 6, 8]])]
    elsewhere = MARKER.corners + np.array([0.4, 0.0, 0.0])
    pixels = np.asarray(COLMAP_CAMERA.img_from_cam(transform(views[1].cam_from_world, elsewhere)))
    moved = MarkerView("1.jpg", COLMAP_CAMERA, views[1].cam_from_world, pixels)
    assert place_marker(7, views).error_px < 1e-4
    with pytest.raises(MapError, match=r"no single place fits .*marker 7.*miss by \d+\.\d px, more than 4\.0.*1\.jpg"):
        place_marker(7, [views[0], moved, views[2]])


def test_a_larger_photograph_may_miss_by_more_pixels() -> None:
    """The same share of the image: what is refused at 480 pixels is 1/400 at eight times as many, and less."""
    rng = np.random.default_rng(0)
    noise = [rng.normal(scale=0.6, size=(4, 2)) for _ in range(5)]
    poses = hand_held_poses()[4:9]

    def placed(times: float) -> float:
        large = pycolmap.Camera(model="PINHOLE", width=int(480 * times), height=int(360 * times), params=[
            CAMERA.focal_px * times, CAMERA.focal_px * times, CAMERA.cx * times, CAMERA.cy * times])  # fmt: skip
        views = [
            MarkerView(f"{row}.jpg", large, pose, np.asarray(large.img_from_cam(transform(pose, MARKER.corners)))
                       + times * noise[row])
            for row, pose in enumerate(poses)
        ]  # fmt: skip
        return place_marker(7, views).error_px

    assert MAX_ERROR_PX < placed(8.0) < MAX_ERROR_SHARE * 8 * 480


def test_a_marker_seen_once_is_refused_by_name() -> None:
    with pytest.raises(MapError, match=r"marker 7 is seen in one photograph only.*door\.jpg"):
        place_marker(7, [view("door.jpg", hand_held_poses()[5])])


def test_a_marker_seen_from_one_place_is_refused() -> None:
    poses = poses_looking_along([[2.6, 1.5, 1.2], [2.6, 1.5, 1.21]], [[0.0, 1.0, 0.0]] * 2)
    with pytest.raises(MapError, match="from one direction"):
        place_marker(7, [view("a.jpg", poses[0], 0.1), view("bb.jpg", poses[1], 0.1)])


def test_the_same_marker_twice_in_an_image_is_refused() -> None:
    kind = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    one = np.pad(cv2.aruco.generateImageMarker(kind, 5, 90), 30, constant_values=255)
    rgb = np.repeat(np.hstack([one, one])[..., None], 3, axis=2)
    with pytest.raises(MapError, match="marker 5 is twice"):
        detect_markers(rgb, "DICT_4X4_50")
    assert set(detect_markers(rgb[:, :150], "DICT_4X4_50")) == {5}


def test_unknown_dictionaries_are_refused() -> None:
    with pytest.raises(ConfigError, match="DICT_4X4_50"):
        detect_markers(np.zeros((50, 50, 3), np.uint8), "DICT_9X9")
