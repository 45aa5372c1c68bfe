"""Markers in images and in the map."""

import cv2
import numpy as np
import pycolmap
import pytest

from mapping.marker_rooms import CAMERA, MARKERS, hand_held_poses, marker_room
from wheretolook.geometry.poses import transform
from wheretolook.mapping.georeference import MarkerView, detect_markers, place_marker
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.utils.errors import MapError

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
    np.testing.assert_allclose(marker.corners, MARKER.corners, atol=1e-6)
    np.testing.assert_allclose(marker.sides, MARKER.size_m, atol=1e-6)
    np.testing.assert_allclose(marker.center, MARKER.center, atol=1e-6)
    assert marker.images == tuple(f"{index}.jpg" for index in range(5)) and marker.error_px < 1e-4


def test_one_bad_view_moves_little():
    views = [view(f"{index}.jpg", pose) for index, pose in enumerate(hand_held_poses()[3:11])]
    off = MarkerView("off.jpg", COLMAP_CAMERA, views[2].cam_from_world, views[2].corners_px + np.array([8.0, 0.0]))
    marker = place_marker(7, [*views, off])
    np.testing.assert_allclose(marker.corners, MARKER.corners, atol=0.01)


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
