"""The viewer in headless Chromium: a click shows the panel, a path plays, a second client joins, nothing complains."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from selection.room import POINTS, WEIGHTS, write_room
from view.browser import Browser, Tab, chromium
from wheretolook.geometry.poses import poses_looking_along, rotation_from_quaternion
from wheretolook.view.opened import open_map
from wheretolook.view.played import FORWARD, Played, looking_ahead
from wheretolook.view.server import Viewer
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

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


def test_a_place_is_clicked_a_path_plays_and_another_joins(viewer: Viewer, browser: Browser, tmp_path: Path) -> None:
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
