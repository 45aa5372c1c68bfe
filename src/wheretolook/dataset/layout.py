"""Where a dataset keeps its files: `<data>/<dataset>/<scene>/`, and which scene belongs to which split."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from wheretolook.dataset.config import Split
from wheretolook.geometry.camera import Camera, PinholeCamera, camera_of_record, read_cameras
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import CAMERAS_FILE, load_mapping_poses
from wheretolook.mapping.georeference import read_scale
from wheretolook.mapping.landmarks import Landmarks, read_feature_name
from wheretolook.mapping.map import Map
from wheretolook.mapping.map_frame import read_frame
from wheretolook.utils.errors import ConfigError, TableError, check_choice
from wheretolook.utils.files import ArtifactCache, fingerprint, read_json_object, safe_child, write_json

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.inputs.localization_map import LocalizationMap

STAGES = ("scenes", "map", "sample", "label")
"""Stages that work scene by scene, in order; the names in `stages.json`."""

MappedFloor = tuple[tuple[float, float, float, float], ...]
"""Regions of the floor that the mapping images cover: rectangles (x0, y0, x1, y1) in metres; empty for the whole floor."""


@dataclass(frozen=True)
class SceneFolder:
    """Files of one scene."""

    folder: Path  # `<data>/<dataset>/<scene>`
    split: Split  # the whole scene belongs to it
    camera: Camera = PinholeCamera()  # of all viewpoints, unless they name one of `cameras.txt`
    own_camera: bool = False  # the camera is that of the COLMAP model, kept unless another one is configured

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.folder.name

    @property
    def mesh(self) -> Path:
        """Textured mesh, GLB, metres, z up."""
        return self.folder / "mesh.glb"

    @property
    def map(self) -> Path:
        """Folder of the COLMAP model, `landmarks.npz` and `cameras.npz`."""
        return self.folder / "map"

    @property
    def landmarks(self) -> Path:
        """Landmarks with their attributes."""
        return self.map / "landmarks.npz"

    @property
    def mapping_cameras(self) -> Path:
        """Poses of the mapping images."""
        return self.map / CAMERAS_FILE

    @property
    def table(self) -> Path:
        """Table of viewpoints."""
        return self.folder / "viewpoints.parquet"

    @property
    def cameras_file(self) -> Path:
        """Cameras of viewpoints by `camera_id`, in COLMAP's text format; only if there are several."""
        return self.folder / "cameras.txt"

    def cameras(self) -> dict[int, Camera]:
        """The cameras of viewpoints by `camera_id`: those of `cameras.txt`, or the scene's one camera as number 0.

        Raises:
            TableError: the file is damaged.
        """
        return read_cameras(self.cameras_file) if self.cameras_file.is_file() else {0: self.camera}

    @property
    def label_manifest(self) -> Path:
        """What the labels were made with: versions, settings, fingerprints, shards."""
        return self.folder / "labels.json"

    @property
    def adapt_shards(self) -> Path:
        """Views that the adapt stage has labelled, while the label stage has not."""
        return self.folder / "adapt-shards"

    @property
    def occlusion(self) -> Path:
        """Unoccluded landmarks of each sampled location."""
        return self.folder / "occlusion.npz"

    @property
    def is_photographed(self) -> bool:
        """Whether the scene is mapped from photographs, without a mesh.

        Raises MapError if it has no mesh, and its map's report is damaged.
        """
        return not self.mesh.is_file() and read_scale(self.map) is not None

    @property
    def source(self) -> Path:
        """The file that everything follows from: the mesh, or else the poses of the photographs."""
        return self.mapping_cameras if self.is_photographed else self.mesh

    def stage_cache(self, stage: str, key: str = "") -> ArtifactCache:
        """The key that a stage of `STAGES` was finished with, in `stages.json`."""
        return ArtifactCache(self.folder, key, stage, "stages.json", STAGES)

    def mapped_floor(self) -> MappedFloor:
        """The floor that `save_mapped_floor` wrote. Raises TableError if the file is damaged."""
        if not self._description.is_file():
            return ()
        try:
            floor = read_json_object(self._description)["mapped_floor"]
            return tuple((float(x0), float(y0), float(x1), float(y1)) for x0, y0, x1, y1 in floor)
        except (ValueError, KeyError, TypeError) as error:
            fix = "Run the scenes stage again."
            raise TableError(f"damaged description: {error}", path=self._description, fix=fix) from error

    def save_mapped_floor(self, floor: MappedFloor) -> None:
        """Write the floor that the map is to be made from to `scene.json`, unless it is all."""
        if floor:
            write_json(self._description, {"mapped_floor": floor})
        else:
            self._description.unlink(missing_ok=True)

    @property
    def _description(self) -> Path:
        return self.folder / "scene.json"

    def read_table(self, matches: bool = False) -> pd.DataFrame:
        """The scene's viewpoints, on request with their matches; see `wheretolook.dataset.viewpoint_files.read_table`."""
        from wheretolook.dataset.viewpoint_files import read_table

        return read_table(self.table, matches)

    def mapping_poses(self) -> Float | None:
        """Poses cam_from_world (M, 3, 4) of the mapping images; None if unknown. Raises MapError if damaged."""
        return load_mapping_poses(self.mapping_cameras) if self.mapping_cameras.is_file() else None

    def read_landmarks(self) -> Landmarks:
        """The map's landmarks. Raises MapError if there is no file of them, or it is damaged."""
        landmarks = Landmarks.load(self.landmarks)
        if landmarks.mapping_focal_px is not None:
            return landmarks
        # in the release, viewpoints have the camera of the mapping images
        focal_px = np.full(len(landmarks), self.camera.mean_focal_px, dtype=np.float32)
        return replace(landmarks, mapping_focal_px=focal_px)

    def open_map(self, device: str = "cpu") -> Map:
        """Open the map with its frame, without the observations of its photographs (`Map.with_images`); reads no model.

        Raises MapError if it is missing, damaged, or in any unit.
        """
        has_photographs = read_scale(self.map) is not None
        frame = read_frame(self.map)
        return Map(self.read_landmarks(), self.mapping_poses(), frame, has_photographs, self.map)

    def localization_map(self, camera: Camera | None = None, device: str = "cpu") -> LocalizationMap:
        """The scene's map with the occlusion stored for its sampled locations; the mesh is not needed.

        Uses the scene's camera unless another one is given.
        """
        from wheretolook.inputs.localization_map import LocalizationMap
        from wheretolook.visibility.occlusion import StoredOcclusion

        landmarks = self.read_landmarks()
        occlusion = StoredOcclusion.load(self.occlusion)
        return LocalizationMap(Map(landmarks, self.mapping_poses()), camera or self.camera, occlusion, device)


def views_by_camera(
    scene: SceneFolder, table: pd.DataFrame, at_most: int = 0
) -> Iterator[tuple[Camera, NDArray[np.int64]]]:
    """Yield each camera of a scene with the ascending rows of its viewpoints, in blocks of `at_most` unless that is 0.

    Raises:
        TableError: a viewpoint names no camera of the scene.
    """
    from wheretolook.dataset.viewpoint_table import CAMERA_ID

    cameras = scene.cameras()
    ids = table[CAMERA_ID].to_numpy() if CAMERA_ID in table else np.full(len(table), next(iter(cameras)))
    if (CAMERA_ID not in table and len(cameras) > 1) or not np.isin(ids, list(cameras)).all():
        fix = "Run the sample stage again."
        raise TableError("viewpoints name no camera of the scene", path=scene.cameras_file, fix=fix)
    for number in np.unique(ids).tolist():
        rows = np.flatnonzero(ids == number)
        block = at_most or len(rows)
        for begin in range(0, len(rows), block):
            yield cameras[number], rows[begin : begin + block]


@dataclass(frozen=True)
class Dataset:
    """A folder of scenes."""

    root: Path  # `<data>/<dataset>`
    scenes: tuple[SceneFolder, ...]  # in the order they were made

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """All cameras of its scenes, each once."""
        return tuple(dict.fromkeys(camera for scene in self.scenes for camera in scene.cameras().values()))

    @property
    def camera(self) -> Camera:
        """The camera of all scenes. Raises ConfigError if there are several, or none."""
        if len(self.cameras) != 1:
            fix = "Use a method that serves every camera, such as set, or a dataset of one camera."
            raise ConfigError("the dataset has no camera, or several", path=self.root, value=len(self.cameras), fix=fix)
        return self.cameras[0]

    @property
    def features(self) -> str:
        """Name of the features of all its maps; "" if they differ, or there is no map. Raises MapError if damaged."""
        names = {read_feature_name(scene.landmarks) for scene in self.scenes if scene.landmarks.is_file()}
        return names.pop() if len(names) == 1 else ""

    @property
    def name(self) -> str:
        """Name of the dataset."""
        return self.root.name

    def split(self, split: Split) -> tuple[SceneFolder, ...]:
        """Scenes of one split."""
        return tuple(scene for scene in self.scenes if scene.split == split)

    def scene(self, name: str) -> SceneFolder:
        """The scene of a name. Raises ConfigError if there is none."""
        known = {scene.name: scene for scene in self.scenes}
        if name in known:
            return known[name]
        fix = f"There are {', '.join(known)}."
        raise ConfigError("there is no such scene", path=self.root, value=name, fix=fix)

    def fingerprint(self) -> str:
        """16 hexadecimal digits that change with any scene's table, landmarks or occlusion."""
        digest = hashlib.sha256()
        for scene in self.scenes:
            files = (scene.table, scene.landmarks, scene.occlusion, scene.cameras_file)
            parts = [fingerprint(path) for path in files if path.is_file()]
            digest.update("".join([scene.name, scene.split, *parts]).encode())
        return digest.hexdigest()[:16]

    def save(self) -> None:
        """Write `dataset.json`, which makes the folder a dataset."""
        scenes: list[dict[str, Any]] = []
        for scene in self.scenes:
            own = {"own_camera": True} if scene.own_camera else {}
            scenes.append({"name": scene.name, "split": scene.split, **own})
        content: dict[str, Any] = {"scenes": scenes}
        if len({scene.camera for scene in self.scenes}) == 1:
            content = {"camera": self.scenes[0].camera.record(), **content}
        else:
            for scene, entry in zip(self.scenes, scenes, strict=True):
                entry["camera"] = scene.camera.record()
        write_json(self.root / "dataset.json", content)

    @classmethod
    def load(cls, root: Path) -> Dataset:
        """Read a dataset folder. Raises TableError if there is no valid `dataset.json`."""
        path = root / "dataset.json"
        fix = "Run the scenes stage, or for a map of your own `wheretolook map --model SPARSE`."
        try:
            content = read_json_object(path)
            scenes = []
            for entry in content["scenes"]:
                check_choice("split", entry["split"], get_args(Split))
                camera = camera_of_record(entry["camera"] if "camera" in entry else content["camera"])
                folder = safe_child(root, entry["name"], "a scene's name")
                scenes.append(SceneFolder(folder, entry["split"], camera, bool(entry.get("own_camera", False))))
        except FileNotFoundError as error:
            raise TableError("not a folder of a dataset", path=path, fix=fix) from error
        except (OSError, ConfigError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise TableError(f"damaged dataset description: {error}", path=path, fix=fix) from error
        return cls(root, tuple(scenes))


def find_scene(data: Path, name: str, dataset: str = "") -> SceneFolder:
    """Find the scene of a name in a dataset, or in the only dataset of a folder that has it.

    Raises ConfigError if there is none, or several datasets have it; TableError if the dataset is damaged.
    """
    if dataset:
        return Dataset.load(safe_child(data, dataset, "a dataset's name")).scene(name)
    roots = [path.parent for path in sorted(data.glob("*/dataset.json"))]
    # datasets without such a folder are not read, so that damaged ones are not in the way
    possible = [Dataset.load(root) for root in roots if safe_child(root, name, "a scene's name").is_dir()]
    having = [one for one in possible if name in {scene.name for scene in one.scenes}]
    if len(having) == 1:
        return having[0].scene(name)
    if having:
        names = ", ".join(one.name for one in having)
        raise ConfigError("several datasets have such a scene", value=name, fix=f"Give --name: {names}.")
    fix = (
        f"Name a scene of {', '.join(root.name for root in roots)}, or make one with `wheretolook map --model SPARSE`."
    )
    raise ConfigError("there is no such scene", path=data, value=name, fix=fix)
