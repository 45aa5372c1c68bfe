"""The photographs that a map was built from, and the one nearest to a view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.confine import path_within
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.images import image_size

METRES_PER_RIGHT_ANGLE = 2.0  # weight of rotation against translation
MAX_ASPECT = 8  # height over width of a displayed photograph


@dataclass(frozen=True, eq=False)
class Photographs:
    """Image files of a map with their poses."""

    folder: Path
    names: tuple[str, ...]
    cam_from_world: Float  # (M, 3, 4)

    @classmethod
    def of_model(cls, model: Path, folder: Path) -> Self | None:
        """Collect the registered images of a COLMAP model that exist in a folder; None if none does."""
        from wheretolook.mapping.colmap_model import read_model

        images = [
            image
            for image in read_model(model).images.values()
            if image.has_pose and _existing_file(folder, image.name) is not None
        ]
        poses = [image.cam_from_world().matrix() for image in images]
        return cls(folder, tuple(image.name for image in images), np.array(poses)) if images else None

    def nearest(self, pose: Float) -> int:
        """Return the number of the photograph nearest to a view (3, 4), by distance plus weighted rotation."""
        distance = np.linalg.norm(camera_centers(self.cam_from_world) - camera_centers(pose), axis=1)
        cosine = self.cam_from_world[:, 2, :3] @ pose[2, :3]
        return int(np.argmin(distance + METRES_PER_RIGHT_ANGLE * (1 - cosine)))

    def read(self, number: int, width: int) -> NDArray[np.uint8]:
        """Read a photograph, (H, W, 3), W pixels wide. Raises ConfigError if its file cannot be read."""
        from PIL import Image

        name = self.names[number]
        path = _existing_file(self.folder, name)
        try:
            if path is None:
                raise FileNotFoundError(name)
            full_width, full_height = image_size(path)
            height = min(max(1, round(full_height * width / full_width)), MAX_ASPECT * width)
            with Image.open(path) as image:
                image.draft("RGB", (width, height))
                small = image if image.mode in ("P", "1") else image.resize((width, height))  # palettes do not mix
                return np.asarray(small.convert("RGB").resize((width, height)))
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            raise ConfigError(f"the photograph cannot be read: {error}", path=self.folder, value=name) from error


def _existing_file(folder: Path, name: str) -> Path | None:
    """Return the path of an image; None if it does not exist or its name leads out of the folder."""
    try:
        path = path_within(folder, name, "an image's name")
    except ConfigError:
        return None
    return path if path.is_file() else None
