"""What one who looks takes along: a picture of the scene, and its state."""

from __future__ import annotations

import io

import numpy as np

from wheretolook.utils.errors import ConfigError
from wheretolook.view.session import Session

WAIT_S = 20.0  # for a browser to draw
LARGEST_PX = 2160


class Share:
    """The button that saves a picture."""

    def __init__(self, session: Session) -> None:
        self.session = session
        session.on(session.controls.photo, self._save_picture, "on_click")

    def _save_picture(self) -> None:
        client = self.session.client
        height, width = client.camera.image_height or 1080, client.camera.image_width or 1920
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
