"""The viewer in headless Chromium: clicks, paths, links; without errors in the browser."""

import numpy as np
import pytest

pytest.importorskip("viser")

from selection.room import POINTS, WEIGHTS, write_room
from wheretolook.geometry.poses import poses_looking_along, rotation_from_quaternion
from wheretolook.geometry.views import Views
from wheretolook.planning.config import FORWARD
from wheretolook.view.server import Viewer
from wheretolook.view.state import ViewState, looking_ahead
from wheretolook.view.viewed_map import open_map
from wheretolook_paper.studies.browser import Browser, chromium

RING = 0.65  # radius of the rings over their size

pytestmark = [pytest.mark.slow, pytest.mark.skipif(chromium() is None, reason="there is no Chromium on the PATH")]


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    viewed = open_map(write_room(tmp_path_factory.mktemp("room") / "sparse"), weights=WEIGHTS)
    poses = poses_looking_along(POINTS, np.tile((-1.0, -0.5, 0.0), (4, 1)))
    localized = np.array([True, True, False, True])
    viewed.paths = {FORWARD: Views(looking_ahead(POINTS)), "set": Views(poses, good=localized)}
    made = Viewer(viewed, port=0, state=ViewState(occlusion="none"))
    yield made
    made.stop()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    made = Browser(tmp_path_factory.mktemp("profile"), (1100, 700))
    yield made
    made.close()


def pixel_of(camera, point):
    """Project a world point into a client's window."""
    x, y, z = rotation_from_quaternion(camera.wxyz).T @ (point - camera.position)
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    return camera.image_width / 2 + focal * x / z, camera.image_height / 2 + focal * y / z


def test_a_location_is_clicked_and_a_link_opens_the_same_view(viewer, browser):
    tab = browser.open(f"http://{viewer.address}")
    tab.wait(lambda tab: "Click a location" in tab.text and " locations" in tab.text)
    (session,) = viewer.sessions.values()
    at = np.array([1.6, 2.1, session.scenery.floor_m])
    tab.click(*pixel_of(session.client.camera, at))
    tab.wait(lambda tab: "landmarks in view" in tab.text)
    location = session.location
    np.testing.assert_allclose(location.position[:2], at[:2], atol=0.1)
    assert f"{location.best.n_visible[0]:,} landmarks in view" in tab.text
    other = browser.open(session.state.link(f"localhost:{viewer.port}"))
    other.wait(lambda tab: "landmarks in view" in tab.text)
    joined = viewer.sessions[max(viewer.sessions)]
    np.testing.assert_allclose(joined.location.position, location.position, atol=0.01)
    assert tab.errors == other.errors == []


def test_rings_turn_the_view(viewer, browser):
    at = np.array([1.6, 2.1, 1.5])
    tab = browser.open(ViewState(occlusion="none", n=3, place=(1.6, 2.1, 1.5)).link(f"localhost:{viewer.port}"))
    tab.wait(lambda tab: "landmarks in view" in tab.text)
    session = viewer.sessions[max(viewer.sessions)]
    before = session.place.axis.copy()
    turn = poses_looking_along(at, before)[:, :3].T  # the rings have the camera's axes
    radius = 3.0 * session.viewed.marker_m * RING
    yaw = [at + radius * turn @ (np.sin(angle), 0, np.cos(angle)) for angle in np.radians((45, 10))]
    start, end = (pixel_of(session.client.camera, point) for point in yaw)
    tab.drag(start, end)
    tab.wait(lambda _: 10 < np.degrees(np.arccos(session.place.axis @ before)) < 80)
    assert tab.errors == []


def test_a_button_leaves_first_person(viewer, browser):
    tab = browser.open(ViewState(occlusion="none", place=(1.6, 2.1, 1.5)).link(f"localhost:{viewer.port}"))
    tab.wait(lambda tab: "landmarks in view" in tab.text)
    assert "camera height" in tab.text and "Leave first person" not in tab.text
    session = viewer.sessions[max(viewer.sessions)]
    before = session.client.camera.position.copy()
    session.controls.inside.value = True
    tab.wait(lambda _: np.linalg.norm(session.client.camera.position - (1.6, 2.1, 1.5)) < 0.2)
    tab.press("Leave first person")
    tab.wait(lambda tab: "Leave first person" not in tab.text and not session.controls.inside.value)
    tab.wait(lambda _: np.linalg.norm(session.client.camera.position - before) < 0.2)
    assert tab.errors == []
