"""The photographs that a map was made from, and which of them is nearest to a view."""

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

AT_AN_ANGLE_M = 2.0  # metres that a right angle between two views counts for
MOST_PROPORTION = 8  # of height to width, as which narrower photographs are shown


@dataclass(frozen=True, eq=False)
class Photographs:
    """Files of a map's images and where each was taken."""

    folder: Path
    names: tuple[str, ...]
    cam_from_world: Float  # (M, 3, 4)

    @classmethod
    def of_model(cls, model: Path, folder: Path) -> Self | None:
        """Those of a COLMAP model's images that lie in a folder; None if none does."""
        from wheretolook.mapping.colmap_model import read_model

        names = []
        poses = []
        for image in read_model(model).images.values():
            if image.has_pose and _file(folder, image.name) is not None:
                names.append(image.name)
                poses.append(image.cam_from_world().matrix())
        return cls(folder, tuple(names), np.array(poses)) if names else None

    def nearest(self, pose: Float) -> int:
        """The photograph that shows most nearly what a view (3, 4) does: by metres, an angle counting as some."""
        away = np.linalg.norm(camera_centers(self.cam_from_world) - camera_centers(pose), axis=1)
        cosine = self.cam_from_world[:, 2, :3] @ pose[2, :3]
        return int(np.argmin(away + AT_AN_ANGLE_M * (1 - cosine)))

    def read(self, number: int, width: int) -> NDArray[np.uint8]:
        """A photograph (H, W, 3), W pixels wide. Raises ConfigError if its file cannot be read."""
        from PIL import Image

        path = _file(self.folder, self.names[number])
        try:
            if path is None:
                raise FileNotFoundError(self.names[number])
            full_width, full_height = image_size(path)
            height = min(max(1, round(full_height * width / full_width)), MOST_PROPORTION * width)
            with Image.open(path) as image:
                image.draft("RGB", (width, height))
                small = image if image.mode in ("P", "1") else image.resize((width, height))  # palettes do not mix
                return np.asarray(small.convert("RGB").resize((width, height)))
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            problem = f"the photograph cannot be read: {error}"
            raise ConfigError(problem, path=self.folder, value=self.names[number]) from error


def _file(folder: Path, name: str) -> Path | None:
    """A model's image, if it lies in the folder; names that lead out of it are none."""
    try:
        path = path_within(folder, name, "an image's name")
    except ConfigError:
        return None
    return path if path.is_file() else None
