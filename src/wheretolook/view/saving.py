"""Save the best views at waypoints and images of the scene."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError
from wheretolook.view.controls import FILES, check_value
from wheretolook.view.scenery import add_points
from wheretolook.view.session import Session
from wheretolook.view.worker import SOON

if TYPE_CHECKING:
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.where_to_look import WhereToLook

MAX_WAYPOINTS = 500
WAYPOINT_COLOR = (213, 94, 0)
RENDER_TIMEOUT_S = 20.0
MAX_IMAGE_PX = 2160


def views_at(selector: WhereToLook, points: Float, n: int, format: str) -> Iterator[SelectedViews]:
    """Select the n best views at each of points (W, 3) m, point by point; one view for formats of trajectories.

    Raises TableError for points outside the map or inside geometry.
    """
    from wheretolook.select.waypoints import Waypoints, usable_waypoints

    usable_waypoints(selector.localization_map, Waypoints.of(points))
    n = 1 if FILES[format][0] in ("tum", "benchmark") else n
    for number, point in enumerate(points):
        views = selector.best(point, n, ids=(str(number),))
        yield replace(views, waypoint=views.waypoint + number)


def views_file(views: Sequence[SelectedViews], format: str) -> bytes:
    """Write views of several points in a format of `FILES`; returns the content of the file."""
    from wheretolook.select.views import joined

    kind, suffix = FILES[format]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"views{suffix}"
        joined(views).save(path, kind)
        return path.read_bytes()


class WaypointList:
    """The waypoints of one client."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.points: list[Float] = []
        controls = session.controls
        session.on(controls.add, self._add_selected, "on_click")
        session.on(controls.clear, self._clear, "on_click")
        session.on(controls.save, self._save, "on_click")

    def add(self, point: Float) -> None:
        """Add a waypoint (3,) m."""
        if len(self.points) >= MAX_WAYPOINTS:
            raise ConfigError("no more waypoints can be added", value=MAX_WAYPOINTS, fix="Save and remove them first.")
        self.points.append(np.asarray(point, dtype=np.float64))
        self._draw()

    def _add_selected(self) -> None:
        location = self.session.place.location
        if location is None:
            raise ConfigError("no place is selected", fix="Click one on the floor first.")
        self.add(location.position)

    def _clear(self) -> None:
        self.points.clear()
        self._draw()

    def _draw(self) -> None:
        session = self.session
        rows = [f"{k + 1}. {x:.2f}, {y:.2f}, {z:.2f}" for k, (x, y, z) in enumerate(self.points)]
        session.controls.waypoints.content = "\n".join(rows) or "No waypoints yet."
        if self.points:
            size_m = 0.35 * session.shared.marker_m
            add_points(session.scene, "/waypoints", np.array(self.points), WAYPOINT_COLOR, size_m)
        else:
            session.scene.remove_by_name("/waypoints")

    def _save(self) -> None:
        if not self.points:
            fix = "Tick `clicks set waypoints` and click the floor, or add the place looked at."
            raise ConfigError("there are no waypoints to save", fix=fix)
        self.session.submit("save", SOON, self._save_views())

    def _save_views(self) -> Iterator[None]:
        session = self.session
        check_value(session.controls.format, next(iter(FILES)))
        format = str(session.controls.format.value)
        views = []
        for selected in views_at(session.selector, np.array(self.points), session.state.n, format):
            views.append(selected)
            yield  # to other jobs
        content = views_file(views, format)
        session.client.send_file_download(f"views{FILES[format][1]}", content, save_immediately=True)


class PictureButton:
    """Saves an image of the scene as the browser shows it."""

    def __init__(self, session: Session) -> None:
        self.session = session
        session.on(session.controls.photo, self._save, "on_click")

    def _save(self) -> None:
        from PIL import Image

        client = self.session.client
        height = client.camera.image_height or 1080
        width = client.camera.image_width or 1920
        scale = min(1.0, MAX_IMAGE_PX / max(height, width))
        try:
            size = max(1, round(height * scale)), max(1, round(width * scale))
            image = client.get_render(*size, transport_format="png", timeout=RENDER_TIMEOUT_S)
        except (TimeoutError, RuntimeError) as error:
            raise ConfigError(f"the browser sent no image: {error}", fix="Keep its window in front.") from error
        file = io.BytesIO()
        Image.fromarray(image).save(file, format="PNG")
        client.send_file_download("wheretolook.png", file.getvalue(), save_immediately=True)
