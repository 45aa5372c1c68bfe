"""`wheretolook map`: a COLMAP model of every scene, of a folder of photographs, or imported from a model."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import wraps
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from wheretolook.commands.options import (
    NOT_SCENES,
    DatasetOptions,
    LabelOptions,
    Log,
    MeshOptions,
    Progress,
    SceneOptions,
    existing,
    ignore_progress,
    load_dataset,
    mesh_fingerprint,
    naming_file,
    open_scene,
    refuse_release,
    select_options,
)
from wheretolook.dataset.config import LOCK
from wheretolook.dataset.dataset_lock import changes_dataset
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import Camera, CameraConfig, PinholeCamera, cameras_by_id, describe_camera, draw_camera
from wheretolook.mapping.colmap_model import find_camera, read_model
from wheretolook.mapping.config import FrameOptions, ImportConfig, MapConfig, PhotographsConfig, place_name
from wheretolook.mapping.feature_files import DATABASE_FILE
from wheretolook.mapping.georeference import REPORT_FILE, read_scale
from wheretolook.mapping.map import choose_features, source_of_map
from wheretolook.mapping.map_frame import check_overlap, read_frame, warn_of_mesh
from wheretolook.mapping.photographs import list_photographs
from wheretolook.utils.errors import ConfigError, MapError, SceneError, reject
from wheretolook.utils.files import ArtifactCache, cache_key, check_folder_name, fingerprint, path_within, size_and_time
from wheretolook.utils.processes import hold

EXTENDED = "extended"  # of a scene: the model with added photographs, in the frame of the one before


@dataclass(frozen=True, kw_only=True)
class BuildMap(SceneOptions, LabelOptions, FrameOptions):
    """Build a COLMAP map of every scene from renders, or of photographs: --images. Or import one: --model.

    A model of your own, from COLMAP or hloc, becomes a scene for sample, viewpoint-map and plan, in metres with z up
    according to --scale, --distance, --positions and --up. Mesh and database are optional. With --images its landmarks
    are triangulated again. Its own camera is the scene's, unless --camera names one.

    --extend adds the photographs of --images to an existing map, whose poses stay as they are.

    Examples:
      wheretolook map --name photos --images FOLDER
      wheretolook map --name mymap --model sparse/0 --mesh scan.glb --database database.db
      wheretolook map --name more --extend data/photos/room --images NEW

    Args:
        mapping: maps of renders.
        photographs: maps of photographs, and the images and markers of a model.
        model: folder of a COLMAP model to import.
        extend: folder of a COLMAP or hloc model, or of a scene, to add the photographs to.
        mesh: textured mesh of the scene in the model's frame, for free space, occlusion and labels. Without one, free
            space follows `scenes.mapped_space`, and occlusion hidden-point removal.
        mesh_up: which axis of the mesh's file is the model's z: x, y or z, with a minus sign if it points down.
        database: the COLMAP database that the model was built from, or hloc's features in HDF5.
        camera_id: the query camera, if the model has several and `camera` names none.
        scene: name of the scene of photographs or of a model; by default that of the folder, and for sparse/0, images
            and the like that of the parent folder.
    """

    SHORT: ClassVar = {
        "images": "mapping.photographs.images",
        "engine": "label.engine",
        **{f"mapping.existing.{name}": name for name in ("model", "mesh", "mesh_up", "database", "camera_id")},
        **{f"mapping.frame.{name}": name for name in ("scale", "distance", "positions", "up")},
        "mapping.existing.name": "scene",
        "mapping.photographs.name": "scene",
    }
    GROUPS: ClassVar = {"photographs": "mapping.photographs."}

    mapping: MapConfig = field(default_factory=MapConfig)
    photographs: PhotographsConfig = field(default_factory=PhotographsConfig)
    model: Path | None = None
    extend: Path | None = None
    mesh: Path | None = None
    mesh_up: str = "z"
    database: Path | None = None
    camera_id: int | None = None
    scene: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        frame = self.frame_options()
        is_rendered = self.model is None and self.photographs.images is None
        of_renders = self.mapping.of_renders
        of_model = [name for name in ("mesh", "database", "camera_id") if getattr(self, name) is not None]
        reject(
            (
                not is_rendered and bool(of_renders),
                "these are for maps of renders, not of photographs or a model",
                of_renders,
            ),
            (is_rendered and frame != FrameOptions(), "scale and up belong to --model or --images", vars(frame)),
            (
                self.model is None and self.extend is None and bool(of_model),
                "these belong to --model or --extend",
                of_model,
            ),
            (
                self.extend is not None and (self.model is not None or self.photographs.images is None),
                "--extend takes --images, and no --model",
                str(self.extend),
            ),
            (
                self.mapping.extractor != ExtractorConfig(),
                "the extractor is given beside mapping: BuildMap(extractor=...)",
                self.mapping.extractor.method,
            ),
        )
        if self.model is not None:
            _ = self.import_config
        elif not is_rendered and self.extend is None:
            _ = self.photographs_config

    @property
    def photographs_config(self) -> PhotographsConfig:
        """How photographs are mapped."""
        return replace(self.photographs, frame=self.frame_options(), **self._kept)

    @property
    def import_config(self) -> ImportConfig:
        """How the model is imported."""
        assert self.model is not None
        given = self.photographs
        return ImportConfig(
            given.images,
            given.max_side_px,
            given.scale,
            self.frame_options(),
            **self._kept,
            model=self.model,
            database=self.database,
        )

    @property
    def _kept(self) -> dict[str, Any]:
        return {"extractor": self.extractor, "keep_database": self.mapping.keep_database}

    @changes_dataset("map")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Dataset:
        """Write a COLMAP model of every scene with attributes of its landmarks, `<scene>/map/`.

        Images are rendered along a walk. `photographs.images` makes one scene of photographs, without a mesh; `model`
        one of that model, with or without a mesh. Raises SceneError or MapError if a mesh or a
        model cannot be read, or no landmark could be triangulated.
        """
        if self.model is None and self.photographs.images is None:
            dataset = load_dataset(self, "scenes")
            for files in dataset.scenes:
                with hold(files.folder / LOCK, "map"):
                    _map_mesh(self, files, log)
                progress(1)
            return dataset
        refuse_release(self.root)
        source = self.extend or self.model or self.photographs.images
        assert source is not None
        new = _new_scene(self, source)
        with hold(new.folder / LOCK, "map"):
            if self.extend is not None:
                scene, dataset = _import_model(_extend(self, new, log), new, log)
            elif self.model is not None:
                scene, dataset = _import_model(self, new, log)
            else:
                scene = _map_photographs(self, new, log)
                dataset = _with_scene(scene, self.root)
        frame = read_frame(scene.map)
        about = "; ".join((frame.describe(), *frame.doubts))
        log(f"{scene.name}: {about}; camera {describe_camera(scene.camera)}")
        dataset.save()
        progress(1)
        return dataset


def _map_mesh(options: BuildMap, files: SceneFolder, log: Log) -> None:
    """Map a scene by renders of its mesh, unless its map is current."""
    config = replace(options.mapping, extractor=options.extractor)
    scene = open_scene(options, files)
    seed = _seed(files)
    made_from = existing(files.mesh, SceneError, "scenes")
    floor = files.mapped_floor()
    camera = _mapping_camera(config, scene.camera, seed)
    views = [asdict(scene.free_space), camera.record(), seed, made_from, *([floor] if floor else [])]
    cache = files.stage_cache("map", cache_key("map", [config.record(), *views]))
    model = (files.map / "cameras.bin", files.map / "images.bin", files.map / "points3D.bin")
    if cache.is_current(files.landmarks) and all(path.exists() for path in model):
        log(f"{scene.name}: reusing {files.map}")
        return
    from wheretolook.mapping.rendered_map import PartOfFloor, build_map

    with naming_file(files.mesh):
        space = PartOfFloor(scene.mesh_space, floor) if floor else scene.mesh_space
        report = build_map(
            scene.mesh,
            scene.renderer,
            space,
            camera,
            config,
            seed,
            files.map,
            scene.raycaster,
            options.n_workers,
            scene.device,
            before_replace=cache.clear,
        )
    cache.store()
    landmarks = f"{report.n_landmarks:,} landmarks from {report.n_registered} images"
    distance = f"median {report.median_distance_to_mesh_cm:.2f} cm from the mesh"
    log(f"{scene.name}: {landmarks}, {distance} -> {files.map}")


def _mapping_camera(config: MapConfig, looking: Camera, seed: int) -> PinholeCamera:
    """Return the camera that maps: from the options, drawn, or the scene's. Raises ConfigError if it has distortion."""
    if config.draw_camera:
        return draw_camera(np.random.default_rng([seed, 1]), any_lens=config.vary == "drift")
    camera = looking if config.camera is None else config.camera.camera
    if not isinstance(camera, PinholeCamera):
        fix = "Give one without distortion: --mapping.camera '{width: 640, height: 480, fov_deg: 90}'."
        raise ConfigError("a mesh is mapped with a pinhole camera", value=camera.model, fix=fix)
    return camera


def _seed(scene: SceneFolder) -> int:
    """Return a seed that depends on the scene's name only."""
    return zlib.crc32(scene.name.encode()) % 2**31


def _extend(options: BuildMap, scene: SceneFolder, log: Log) -> BuildMap:
    """Add photographs to the model in `extend`: `<scene>/extended/`. Returns options that import the result.

    Raises what `extend_map` does.
    """
    source, images = options.extend, options.photographs.images
    assert source is not None and images is not None
    extended = scene.folder / EXTENDED
    database = extended / DATABASE_FILE
    files = [*source.rglob("*"), *(images / name for name in list_photographs(images, 1))]
    files += filter(None, [options.database])
    config = replace(options.photographs, extractor=options.extractor)
    key = cache_key("extend", config.record(), options.extractor.record(), size_and_time(filter(Path.is_file, files)))
    cache = ArtifactCache(extended, key, "extend", "steps.json")
    if not cache.is_current(database, extended / REPORT_FILE):
        from wheretolook.mapping.extended_map import extend_map  # loads pycolmap

        report = extend_map(
            source, config, extended, options.database, _seed(scene), options.n_workers, options.warp_device
        )
        cache.store()
        placed = f"{report.n_placed} of {report.n_photographs} photographs placed, {len(report.skipped)} known before"
        landmarks = f"{report.n_new_landmarks:,} new landmarks, {report.n_extended_landmarks:,} seen more often"
        log(f"{scene.name}: {placed}; {landmarks} -> {extended}")
        for name, reason in report.unplaced.items():
            log(f"{scene.name}: not placed: {name}: {reason}")
    number = _most_used_camera(read_model(extended)) if options.camera_id is None else options.camera_id
    result = replace(options, extend=None, model=extended, database=database, camera_id=number)
    return replace(result, photographs=PhotographsConfig(), scene=scene.name)


def _map_photographs(options: BuildMap, scene: SceneFolder, log: Log) -> SceneFolder:
    """Map the photographs in `photographs.images`: `<scene>/map/`, with finished steps in `<scene>/photographs/`.

    Returns the scene, with the camera of most photographs unless one is configured. Raises what `map_photographs` does.
    """
    settings = options.photographs_config
    folder = settings.images
    assert folder is not None
    _with_scene(scene, options.root)
    tables = list(filter(None, (settings.scale.marker_table, settings.frame.positions)))
    for path in tables:
        if not path.is_file():
            raise ConfigError("there is no such table", path=path)
    images = size_and_time([folder / name for name in list_photographs(folder)])
    used = [{**settings.record(), "name": options.scene}, settings.extractor.record(), asdict(settings.frame)]
    made_from = [images, [fingerprint(path) for path in tables]]
    cache = scene.stage_cache("map", cache_key("map", [*used, settings.keep_database, _seed(scene), *made_from]))
    if cache.is_current(scene.landmarks, scene.mapping_cameras):
        log(f"{scene.name}: reusing {scene.map}")
        return _with_mapping_camera(options, scene)

    from wheretolook.mapping.photograph_map import map_photographs  # loads pycolmap

    report = map_photographs(
        settings,
        scene.map,
        scene.folder / "photographs",
        _seed(scene),
        options.n_workers,
        options.warp_device,
        before_replace=cache.clear,
    )
    cache.store()
    used_images = f"{report.n_registered} of {report.n_images} photographs"
    log(f"{scene.name}: {report.n_landmarks:,} landmarks from {used_images} -> {scene.map}")
    if len(report.mappers) > 1:
        tried = ", ".join(f"{mapper} {n}" for mapper, n in report.mappers.items())
        log(f"{scene.name}: photographs placed by each mapping that was tried: {tried}; the best is kept")
    if report.unregistered:
        log(f"{scene.name}: not placed: {', '.join(report.unregistered)}")
    return _with_mapping_camera(options, scene)


def _import_model(options: BuildMap, scene: SceneFolder, log: Log) -> tuple[SceneFolder, Dataset]:
    """Make a scene of the model in `options.model`: `<scene>/map/`, and `<scene>/mesh.glb` if a mesh is given.

    Returns the scene, and the dataset with it. Raises what `map_existing` does, and SceneError if the mesh cannot be used.
    """
    settings = options.import_config
    folder = settings.model
    model = read_model(folder)
    if settings.images is None:
        settings = replace(settings, database=choose_features(folder, model, settings.database))
    if options.camera == CameraConfig():
        scene = _with_own_camera(scene, model, folder, options.camera_id)
    dataset = _with_scene(scene, options.root)
    tables = [settings.scale.marker_table, settings.frame.positions, settings.database]
    files = [*sorted(folder.iterdir()), *filter(None, tables)]
    if settings.images is not None:
        names = [image.name for _, image in sorted(model.images.items())]
        files += [path_within(settings.images, name, "the name of a model's image") for name in names]
    mesh = [] if options.mesh is None else [mesh_fingerprint(options.mesh), options.mesh_up]
    chosen = [settings.report(), settings.extractor.record()]
    made_from = size_and_time(filter(Path.is_file, files))
    cache = scene.stage_cache("map", cache_key("map", [chosen, _seed(scene), made_from, mesh]))
    if cache.is_current(scene.landmarks, scene.mapping_cameras, *([scene.mesh] if mesh else [])):
        log(f"{scene.name}: reusing {scene.map}")
        return scene, dataset
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.scenes.loading import load_mesh, save_glb

    loaded = None
    if options.mesh is not None:
        loaded = load_mesh(options.mesh, options.mesh_up, colored=False)
        if model.num_points3D():
            check_overlap(options.mesh, [point.xyz for point in model.points3D.values()], loaded.bounds)
    cache.clear()
    from wheretolook.mapping.imported_map import map_existing  # loads pycolmap

    report = map_existing(
        settings,
        scene.map,
        scene.folder / "photographs",
        _seed(scene),
        options.n_workers,
        options.warp_device,
        reconstruction=model,
    )
    scene.mesh.unlink(missing_ok=True)
    if options.mesh is not None and loaded is not None:
        loaded = loaded.transformed(read_frame(scene.map).world_from_map)
        warn_of_mesh(options.mesh, scene.read_landmarks().points, MeshRaycaster(loaded, options.warp_device))
        save_glb(loaded, scene.mesh)
    cache.store()
    removed = f", {report.n_landmarks_removed:,} points removed" if report.n_landmarks_removed else ""
    again = ", triangulated again," if report.retriangulated else ""
    log(f"{scene.name}: {report.n_landmarks:,} landmarks{again} from {report.n_images} images{removed} -> {scene.map}")
    return scene, dataset


def _new_scene(options: BuildMap, source: Path) -> SceneFolder:
    """Return the scene of a folder of photographs or a model.

    Raises ConfigError if the name cannot be a folder's, or the scene's map would be replaced by one of another source.
    """
    name = options.scene or place_name(source)
    check_folder_name("a scene's name, --scene,", name, NOT_SCENES)
    scene = SceneFolder(options.root / name, "test", options.camera.camera)
    if source.resolve().is_relative_to(scene.folder.resolve()):
        fix = f"Name the scene instead of its map: --name {options.name} --scene {name}."
        raise ConfigError("this is a part of a scene, which would be replaced", path=source, fix=fix)
    known = source_of_map(scene.map)
    if known == scene.folder / EXTENDED:
        known = source_of_map(known)
    if known is not None and known.resolve() != source.resolve():
        fix = f"Give another dataset, --name, or remove {scene.folder}."
        raise ConfigError(f"the scene {name} was made from another source", path=known, value=str(source), fix=fix)
    return scene


def _with_mapping_camera(options: BuildMap, scene: SceneFolder) -> SceneFolder:
    """Return the scene with the camera that took most of its photographs, unless the options configure one."""
    if options.camera != CameraConfig():
        return scene
    model = read_model(scene.map)
    camera = cameras_by_id(model.cameras, scene.map)[_most_used_camera(model)]
    return replace(scene, camera=camera, own_camera=True)


def _most_used_camera(model: Any) -> int:
    """Return the camera_id of most images with a pose."""
    taken = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    ((number, _),) = taken.most_common(1)
    return int(number)


def _with_own_camera(scene: SceneFolder, model: Any, folder: Path, camera_id: int | None) -> SceneFolder:
    """Return the scene with a camera of the model in a folder."""
    try:
        camera = find_camera(cameras_by_id(model.cameras, folder), folder, camera_id)
        return replace(scene, camera=camera, own_camera=True)
    except MapError as error:
        fix = "Name one of the model's, such as --camera-id 1, or describe another, such as --camera.fov_deg 70."
        raise MapError(error.problem, path=error.path, value=error.value, fix=fix) from error


def _with_scene(scene: SceneFolder, root: Path) -> Dataset:
    """Return the dataset with a scene of photographs or of a model added or replaced.

    Raises ConfigError if the dataset holds scenes that are mapped from meshes.
    """
    known = Dataset.load(root).scenes if (root / "dataset.json").is_file() else ()
    if not all(read_scale(other.map) for other in known):  # maps of meshes have none
        problem = "this dataset holds scenes with meshes, which photographs do not join"
        names = [other.name for other in known]
        raise ConfigError(problem, path=root, value=names, fix="Give the photographs a dataset of their own: --name.")
    scenes = [scene]
    for other in known:
        if not (other.own_camera or scene.own_camera or other.camera == scene.camera):
            stage = other.stage_cache("map")  # what was sampled with another camera is no longer valid
            other.stage_cache("map", stage.stored_key or "").store()
            other = replace(other, camera=scene.camera)
        if other.name != scene.name:
            scenes.append(other)
    return Dataset(root, tuple(sorted(scenes, key=lambda scene: scene.name)))


@dataclass(frozen=True, kw_only=True)
class SceneOrMapOptions(MeshOptions, SceneOptions, FrameOptions):
    """A scene of a dataset, or a COLMAP model.

    Args:
        name: name of the dataset; by default demo, or with --map that of the map.
        map: instead of a scene: folder of a COLMAP model, imported first as `wheretolook map --model` does.
        database: the map's features: COLMAP's database.db, or hloc's feats-*.h5.
        camera_id: the camera_id of one of the map's cameras, if it has several.
    """

    name: str = ""
    map: Path | None = None
    database: Path | None = None
    camera_id: int | None = None

    def __post_init__(self) -> None:
        frame = self.frame_options()
        of_map = next(filter(None, (self.mesh, self.database, self.camera_id, *vars(frame).values())), None)
        names = "--mesh, --database, --camera-id, --scale, --distance, --positions and --up"
        reject((self.map is None and of_map is not None, f"{names} belong to --map", str(of_map)))
        if not self.name:
            object.__setattr__(self, "name", self.imported_name or DatasetOptions.name)
        super().__post_init__()

    @property
    def imported_name(self) -> str:
        """Name of the scene that `map` is imported as; empty without it."""
        return "" if self.map is None else place_name(self.map)


def imports_map(run: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate `run` of a command to import the model in its option `map` first, unless its scene is up to date."""

    @wraps(run)
    def run_on_scene(command: Any, log: Log = print, progress: Progress = ignore_progress) -> Any:
        if command.map is not None:
            select_options(BuildMap, command, model=command.map).run(log)
        return run(command, log, progress)

    return run_on_scene
