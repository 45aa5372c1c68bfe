"""The files of a scene folder of the Active Localization Benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.mapping.colmap_model import holds_model
from wheretolook.utils.errors import MapError, SceneError, TableError, WhereToLookError

CAMERA = PinholeCamera(320, 320, 277.0, center_px=(159.5, 159.5))
"""The benchmark's camera (its camera.py), of 60 degrees: that of its maps, and the one it localizes with."""

DRAWN_CAMERA = PinholeCamera(320, 320, 277.0)
"""The camera that its images are rendered with.

The viewer's principal point is the image centre, (160, 160) in COLMAP's pixels, whose first centre is (0.5, 0.5); the
benchmark's (159.5, 159.5) is the same point with pixel centres at integers. Its scripts shift keypoints to COLMAP's
pixels but not the principal point, so maps and queries share an offset of half a pixel (0.1 degrees), which cancels.
"""

_WAYPOINTS = ("waypoints.txt", "sampled_waypoints.txt", "sampled_viewpoints.txt")
_MODELS = ("scene_reconstruction", "scene_reconstruction/reference_sfm")
_SEE = "`wheretolook benchmark --help` lists the files of a scene folder."


@dataclass(frozen=True)
class BenchmarkScene:
    """The files of a scene."""

    name: str
    model: Path  # folder of the COLMAP model
    images: Path  # folder of the map's images, which may be missing
    mesh: Path
    waypoints: Path

    @classmethod
    def of(cls, folder: Path, mesh: Path | None = None, waypoints: Path | None = None) -> BenchmarkScene:
        """Find the files of a scene folder, except those given.

        Raises a SceneError without folder or mesh, a MapError without model, a TableError without waypoints.
        """
        folder = folder.resolve()
        models = [folder / name for name in _MODELS if holds_model(folder / name)]
        if not models:
            problem = "the scene lacks its COLMAP model: cameras, images and points3D, .bin or .txt"
            raise MapError(problem, path=folder / _MODELS[0], fix=_SEE)
        # folders are named as in the Habitat-Matterport dataset, "00010-DBjEcHFg4oq"
        meshes = [folder / f"{name}.glb" for name in (folder.name.partition("-")[2], folder.name) if name]
        others = [*folder.glob("*.glb")]
        return cls(
            folder.name,
            models[0],
            folder / "scene_reconstruction" / "images",
            _first([mesh] if mesh else [*meshes, *(others if len(others) == 1 else [])], SceneError, "its mesh"),
            _first([waypoints] if waypoints else [folder / name for name in _WAYPOINTS], TableError, "its waypoints"),
        )

    def image_file(self, name: str) -> Path:
        """Return the file of a map image. Raises a MapError if there is none.

        Names in the benchmark's models are paths as passed to its scripts, such as "scene_reconstruction/images/0.png";
        of a path that leaves the scene only the last part is used.
        """
        path = Path(name)
        places = [self.images / path.name]
        if not path.is_absolute() and ".." not in path.parts:
            places = [self.images / path, self.images.parent.parent / path, *places]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            fix = "Copy it there, or localize with the benchmark's own script: --localizer none."
            raise MapError("an image of the map is missing", path=places[-1], value=name, fix=fix)
        return found


def _first(paths: list[Path], error: type[WhereToLookError], what: str) -> Path:
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        raise error(f"the scene lacks {what}", path=paths[0], fix=_SEE)
    return found
