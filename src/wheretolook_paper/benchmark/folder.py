"""The files of a scene folder of the Active Localization Benchmark."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.mapping.colmap_model import holds_model
from wheretolook.utils.confine import path_within
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError, WhereToLookError

CAMERA = PinholeCamera(320, 320, 277.0, center_px=(159.5, 159.5))
"""The benchmark's camera (its camera.py), of 60 degrees: that of its maps, and the one it localizes with."""

DRAWN_CAMERA = PinholeCamera(320, 320, 277.0)
"""The camera that its images are rendered with.

The viewer's principal point is the image centre, (160, 160) in COLMAP's pixels, whose first centre is (0.5, 0.5); the
benchmark's (159.5, 159.5) is the same point with pixel centres at integers. Its scripts shift keypoints to COLMAP's
pixels but not the principal point, so maps and queries share an offset of half a pixel (0.1 degrees), which cancels.
"""

LAYOUT = """\
SCENE_DIR, such as 00010-DBjEcHFg4oq
  scene_reconstruction/    COLMAP model (cameras, images, points3D; binary or text) in metres, z up
    images/                images of the map
  waypoints.txt            "id x y z"; or sampled_waypoints.txt, or name another: --waypoints
  DBjEcHFg4oq.glb          mesh in the frame of the map; or the only .glb of the folder, or name another: --mesh"""

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
        if not folder.is_dir():
            raise SceneError("there is no such scene folder", path=folder, fix=_SEE)
        models = [folder / name for name in _MODELS]
        model = next((path for path in models if holds_model(path)), None)
        if model is None:
            problem = "the scene lacks its COLMAP model: cameras, images and points3D, .bin or .txt"
            raise MapError(problem, path=models[0], fix=_SEE)
        return cls(
            folder.name,
            model,
            folder / "scene_reconstruction" / "images",
            _given(mesh, SceneError, "mesh") or _mesh(folder),
            _given(waypoints, TableError, "file of waypoints") or _waypoints(folder),
        )

    def image_file(self, name: str) -> Path:
        """Return the file of a map image. Raises a MapError if there is none.

        Names in the benchmark's models are paths as passed to its scripts, such as "scene_reconstruction/images/0.png".
        """
        self.check_images()
        places = [self.images / Path(name).name]
        with suppress(ConfigError):  # of a path outside the scene only the last part is used
            above = self.images.parent.parent
            places = [*(path_within(folder, name, "an image's name") for folder in (self.images, above)), *places]
        found = next((path for path in places if path.is_file()), None)
        if found is None:
            raise MapError("an image of the map is missing", path=places[-1], value=name, fix="Copy it there.")
        return found

    def check_images(self) -> None:
        """Raise a MapError if the folder of the map's images is missing."""
        if not self.images.is_dir():
            fix = "Put the images of the map there, or localize with the benchmark's own script: --localizer none."
            raise MapError("the images of the map are missing", path=self.images, fix=fix)


def _given(path: Path | None, error: type[WhereToLookError], what: str) -> Path | None:
    if path is not None and not path.is_file():
        raise error(f"there is no such {what}", path=path, fix="Correct the path.")
    return path


def _mesh(folder: Path) -> Path:
    # folders are named as in the Habitat-Matterport dataset, "00010-DBjEcHFg4oq"
    named = [folder / f"{name}.glb" for name in (folder.name.partition("-")[2], folder.name) if name]
    found = [path for path in named if path.is_file()] or sorted(folder.glob("*.glb"))
    if not found:
        raise SceneError("the scene lacks its mesh", path=named[0], fix="Put it there, or give --mesh FILE.")
    if len(found) > 1 and found[0] not in named:
        names = ", ".join(path.name for path in found)
        raise SceneError("there are several meshes", path=folder, value=names, fix="Choose one: --mesh FILE.")
    return found[0]


def _waypoints(folder: Path) -> Path:
    found = next((folder / name for name in _WAYPOINTS if (folder / name).is_file()), None)
    if found is None:
        fix = f"Put them there (or {', '.join(_WAYPOINTS[1:])}), or give --waypoints FILE."
        raise TableError("the scene lacks its waypoints", path=folder / _WAYPOINTS[0], fix=fix)
    return found
