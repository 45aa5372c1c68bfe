"""The viewer in headless Chromium: a click shows the panel, a path plays, a second client joins, nothing complains."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser")

from selection.room import POINTS, WEIGHTS, write_room
from view.browser import Browser, Tab, chromium
from wheretolook.geometry.poses import poses_looking_along, rotation_from_quaternion
from wheretolook.view.opened import open_map
from wheretolook.view.paths import FORWARD, Played, looking_ahead
from wheretolook.view.saving import views_at, views_file
from wheretolook.view.server import Viewer
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

RING = 0.65  # radius of the rings, of their size

pytestmark = [pytest.mark.slow, pytest.mark.skipif(chromium() is None, reason="there is no Chromium on the PATH")]


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    opened = open_map(write_room(tmp_path_factory.mktemp("room") / "sparse"), weights=WEIGHTS)
    told = poses_looking_along(POINTS, np.tile((-1.0, -0.5, 0.0), (4, 1)))
    paths = {FORWARD: Played(looking_ahead(POINTS)), "set": Played(told, np.array([True, True, False, True]))}
    made = Viewer(Shared(opened, paths), port=0, state=ViewState(occlusion="none"))
    yield made
    made.stop()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    made = Browser(tmp_path_factory.mktemp("profile"), (1100, 700))
    yield made
    made.close()


def pixel_of(camera: Any, point: np.ndarray) -> tuple[float, float]:
    """Where a client sees a point of the world."""
    x, y, z = rotation_from_quaternion(camera.wxyz).T @ (point - camera.position)
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    return camera.image_width / 2 + focal * x / z, camera.image_height / 2 + focal * y / z


def test_a_place_is_clicked_a_path_plays_and_another_joins(
    viewer: Viewer, browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wheretolook.view.player.STEP_S", 1.0)  # a page drawn by software may skip what is shorter
    tab = browser.open(viewer.url)
    tab.wait(lambda tab: "Click a place" in tab.text and " places" in tab.text)
    (session,) = viewer.sessions.values()
    at = np.array([1.6, 2.1, session.scenery.drawn_m])
    tab.click(*pixel_of(session.client.camera, at))
    tab.wait(lambda tab: "landmarks in view" in tab.text)
    assert session.place is not None
    np.testing.assert_allclose(session.place.position[:2], at[:2], atol=0.1)
    best = session.place.best
    assert f"{best.score[0]:.3g}"[:4] in tab.text and f"{best.n_visible[0]:,} landmarks in view" in tab.text
    _plays(tab)
    link = session.state.link(f"localhost:{viewer.port}")
    other = browser.open(link)
    other.wait(lambda tab: "landmarks in view" in tab.text)
    assert len(viewer.sessions) == 2
    joined = next(found for found in viewer.sessions.values() if found is not session)
    np.testing.assert_allclose(joined.place.position, session.place.position, atol=0.01)
    np.testing.assert_allclose(joined.client.camera.position, session.client.camera.position, atol=0.02)
    for page in (tab, other):
        page.picture(tmp_path / "page.png")
        assert page.errors == []


def _plays(tab: Tab) -> None:
    tab.press("Path")
    tab.wait(lambda tab: "forward: score" in tab.text and "● localized" in tab.text)
    tab.press("Play")
    tab.wait(lambda tab: "● lost" in tab.text)
    tab.wait(lambda tab: "● localized" in tab.text)  # at the end
    tab.press("Look")


def _until(what: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_waypoints_and_a_picture_are_saved_and_rings_turn_the_camera(
    viewer: Viewer, browser: Browser, tmp_path: Path
) -> None:
    known = {*viewer.sessions}
    at = (1.6, 2.1, 1.5)
    tab = browser.open(ViewState(occlusion="none", n=3, place=at).link(f"localhost:{viewer.port}"))
    tab.downloads(tmp_path)
    tab.wait(lambda tab: "landmarks in view" in tab.text)
    session = viewer.sessions[next(iter({*viewer.sessions} - known))]
    assert "weights given: set.safetensors" in tab.text
    tab.press("Waypoints")
    tab.press("Add the place looked at")
    _until(lambda: "1.60, 2.10, 1.50" in session.controls.waypoints.content)
    tab.press("Save with best views")
    _until((tmp_path / "views.csv").is_file)
    wanted = views_at(session.shared.look("set", "none"), np.array([at]), 3, "CSV")
    assert (tmp_path / "views.csv").read_bytes() == views_file([*wanted], "CSV")
    tab.press("Share")
    tab.press("Save a picture")
    _until((tmp_path / "wheretolook.png").is_file)
    with Image.open(tmp_path / "wheretolook.png") as picture:
        assert picture.width > 300 and len(picture.convert("RGB").getcolors(1 << 24)) > 50
    tab.press("Look")
    before = session.axis.copy()
    told = session.controls.picture_told.content
    turn = poses_looking_along(np.array(at), before)[:, :3].T  # the rings' axes are the camera's
    reach = 3.0 * session.shared.mark_m * RING
    yaw = [np.array(at) + reach * turn @ (np.sin(angle), 0, np.cos(angle)) for angle in np.radians((45, 10))]
    start, end = (pixel_of(session.client.camera, point) for point in yaw)
    tab.drag(start, end)
    _until(lambda: session.controls.picture_told.content != told)
    assert 10 < np.degrees(np.arccos(session.axis @ before)) < 80
    assert tab.errors == []
