"""What one who looks takes along: the best views at waypoints placed by hand, and a picture of the scene."""

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
from wheretolook.view.session import Session
from wheretolook.view.worker import SOON

if TYPE_CHECKING:
    from wheretolook.select.views import SelectedViews
    from wheretolook.select.where_to_look import WhereToLook

MOST = 500  # waypoints
COLOR = (213, 94, 0)
WAIT_S = 20.0  # for a browser to draw a picture
LARGEST_PX = 2160


def views_at(look: WhereToLook, points: Float, n: int, format: str) -> Iterator[SelectedViews]:
    """The n best views at each of points (W, 3) m, one point at a time; for formats of one view each the best.

    Raises a TableError for points outside the map or inside geometry.
    """
    from wheretolook.select.surroundings import usable_waypoints
    from wheretolook.select.waypoints import Waypoints

    usable_waypoints(look.localization_map, Waypoints.of(points))
    for number, point in enumerate(points):
        found = look.best(point, 1 if FILES[format][0] in ("tum", "benchmark") else n, ids=(str(number),))
        yield replace(found, waypoint=found.waypoint + number)


def views_file(views: Sequence[SelectedViews], format: str) -> bytes:
    """The file of views of several points, one after another, in a format of `FILES`."""
    from wheretolook.select.views import joined

    kind, ending = FILES[format]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"views{ending}"
        joined(views).save(path, kind)
        return path.read_bytes()


class WaypointList:
    """The waypoints of one client."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.points: list[Float] = []
        controls = session.controls
        session.on(controls.add, self._add_place, "on_click")
        session.on(controls.clear, self._clear, "on_click")
        session.on(controls.save, self._save, "on_click")

    def add(self, point: Float) -> None:
        """Place one more."""
        if len(self.points) >= MOST:
            raise ConfigError("there is room for no more waypoints", value=MOST, fix="Save these and begin anew.")
        self.points.append(np.asarray(point, dtype=np.float64))
        self._draw()

    def _add_place(self) -> None:
        if self.session.place is None:
            raise ConfigError("no place is looked at", fix="Click one on the floor first.")
        self.add(self.session.place.position)

    def _clear(self) -> None:
        self.points.clear()
        self._draw()

    def _draw(self) -> None:
        scene = self.session.scene
        size = self.session.shared.mark_m
        rows = [f"{k + 1}. {x:.2f}, {y:.2f}, {z:.2f}" for k, (x, y, z) in enumerate(self.points)]
        self.session.controls.waypoints.content = "\n".join(rows) or "No waypoints yet."
        if not self.points:
            scene.remove_by_name("/waypoints")
            return
        at = np.array(self.points)
        scene.add_point_cloud(
            "/waypoints",
            (at - at[0]).astype(np.float32),
            COLOR,
            point_size=0.35 * size,
            point_shape="circle",
            precision="float32",
            position=at[0],
            point_shading="flat",
        )

    def _save(self) -> None:
        if not self.points:
            fix = "Tick `clicks set waypoints` and click the floor, or add the place looked at."
            raise ConfigError("there are no waypoints to save", fix=fix)
        self.session.submit("save", SOON, self._saved())

    def _saved(self) -> Iterator[None]:
        session = self.session
        check_value(session.controls.format, next(iter(FILES)))
        format = str(session.controls.format.value)
        look = session.shared.look(session.state.method, session.state.occlusion)
        views = []
        for found in views_at(look, np.array(self.points), session.state.n, format):
            views.append(found)
            yield  # others do not wait for hundreds of places
        content = views_file(views, format)
        session.client.send_file_download(f"views{FILES[format][1]}", content, save_immediately=True)
        yield


class PictureButton:
    """Saves a picture of what is seen."""

    def __init__(self, session: Session) -> None:
        self.session = session
        session.on(session.controls.photo, self._save_picture, "on_click")

    def _save_picture(self) -> None:
        client = self.session.client
        height = client.camera.image_height or 1080
        width = client.camera.image_width or 1920
        scale = min(1.0, LARGEST_PX / max(height, width))
        try:
            size = max(1, round(height * scale)), max(1, round(width * scale))
            image = client.get_render(*size, transport_format="png", timeout=WAIT_S)
        except (TimeoutError, RuntimeError) as error:
            raise ConfigError(f"the browser gave no picture: {error}", fix="Keep its window in front.") from error
        client.send_file_download("wheretolook.png", _png(image), save_immediately=True)


def _png(image: np.ndarray) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG")
    return file.getvalue()
