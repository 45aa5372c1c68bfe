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
from wheretolook.view.controls import FILES, value_of
from wheretolook.view.session import Session
from wheretolook.view.worker import SOON

if TYPE_CHECKING:
    from viser import ClientHandle

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
        session.on(session.controls.add, self._add_selected)
        session.on(session.controls.clear, self._clear)
        session.on(session.controls.save, self._save)

    def add(self, point: Float) -> None:
        """Add a waypoint (3,) m."""
        if len(self.points) >= MAX_WAYPOINTS:
            raise ConfigError("no more waypoints can be added", value=MAX_WAYPOINTS, fix="Save and remove them first.")
        self.points.append(point)
        self._draw()

    def _add_selected(self) -> None:
        if self.session.location is None:
            raise ConfigError("no location is selected", fix="Click one on the floor first.")
        self.add(self.session.location.position)

    def _clear(self) -> None:
        self.points.clear()
        self._draw()

    def _draw(self) -> None:
        session = self.session
        places = session.viewed.frame.world_from_map.inverse.apply(self.points) if self.points else ()
        rows = [f"{k + 1}. {x:.2f}, {y:.2f}, {z:.2f}" for k, (x, y, z) in enumerate(places)]
        session.controls.waypoints.content = "\n".join(rows) or "No waypoints yet."
        session.add_points("/waypoints", np.array(self.points), WAYPOINT_COLOR, 0.35 * session.viewed.marker_m)

    def _save(self) -> None:
        if not self.points:
            fix = "Tick `add waypoints by clicks` and click the floor, or add the selected location."
            raise ConfigError("there are no waypoints to save", fix=fix)
        format = str(value_of(self.session.controls.format))
        self.session.submit("save", SOON, self._save_views(np.array(self.points), format))

    def _save_views(self, points: Float, format: str) -> Iterator[None]:
        session = self.session
        views = []
        for selected in views_at(session.selector, points, session.state.n, format):
            place = session.viewed.frame.world_from_map.inverse.apply_to_poses
            views.append(replace(selected, cam_from_world=place(selected.cam_from_world), frame=session.viewed.frame))
            yield  # to other jobs
        content = views_file(views, format)
        session.client.send_file_download(f"views{FILES[format][1]}", content, save_immediately=True)


def save_picture(client: ClientHandle) -> None:
    """Download an image of the scene as the browser shows it. Raises ConfigError if the browser sends none."""
    from PIL import Image

    size = np.array([client.camera.image_height or 1080, client.camera.image_width or 1920])
    height, width = np.maximum(1, np.round(size * min(1.0, MAX_IMAGE_PX / size.max()))).astype(int).tolist()
    try:
        image = client.get_render(height, width, transport_format="png", timeout=RENDER_TIMEOUT_S)
    except (TimeoutError, RuntimeError) as error:
        raise ConfigError(f"the browser sent no image: {error}", fix="Keep its window in front.") from error
    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG")
    client.send_file_download("wheretolook.png", file.getvalue(), save_immediately=True)
