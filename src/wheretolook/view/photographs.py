"""The photographs that a map was built from, and the one nearest to a view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.similarity import Similarity
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
    def of_model(cls, model: Path, folder: Path, world_from_map: Similarity) -> Self | None:
        """Collect the registered images of a COLMAP model that exist in a folder; None if none does."""
        from wheretolook.mapping.colmap_model import read_model
        from wheretolook.mapping.mapped_images import has_image

        images = read_model(model).images.values()
        shown = [image for image in images if image.has_pose and has_image(folder, image.name)]
        poses = [image.cam_from_world().matrix() for image in shown]
        names = tuple(image.name for image in shown)
        return cls(folder, names, world_from_map.apply_to_poses(poses)) if shown else None

    def nearest(self, pose: Float) -> int:
        """Return the number of the photograph nearest to a view (3, 4), by distance plus weighted rotation."""
        distance = np.linalg.norm(camera_centers(self.cam_from_world) - camera_centers(pose), axis=1)
        cosine = self.cam_from_world[:, 2, :3] @ pose[2, :3]
        return int(np.argmin(distance + METRES_PER_RIGHT_ANGLE * (1 - cosine)))

    def read(self, number: int, width: int) -> NDArray[np.uint8]:
        """Read a photograph, (H, W, 3), W pixels wide. Raises ConfigError if its file cannot be read."""
        from PIL import Image

        path = self.folder / self.names[number]
        try:
            full_width, full_height = image_size(path)
            height = min(max(1, round(full_height * width / full_width)), MAX_ASPECT * width)
            with Image.open(path) as image:
                image.draft("RGB", (width, height))
                return np.asarray(image.resize((width, height)).convert("RGB"))
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            raise ConfigError(f"the photograph cannot be read: {error}", path=path) from error
