"""Options that commands share, and the datasets, files and settings that earlier commands must have left."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, get_args

from wheretolook.dataset.config import RELEASE_FILE, SampleConfig
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.scene import Scene
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import Camera, CameraConfig, describe_camera
from wheretolook.geometry.camera_files import read_camera
from wheretolook.localization.config import LabelConfig
from wheretolook.mapping.config import MapConfig
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.space.config import FreeSpaceConfig, MappedSpaceConfig
from wheretolook.tracking import TrackingConfig
from wheretolook.utils.devices import check_device_name, usable_device
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError, WeightsError, from_record, reject
from wheretolook.utils.files import (
    check_folder_name,
    check_output,
    check_output_folder,
    fingerprint,
    read_json_object,
    safe_child,
)
from wheretolook.utils.processes import cores
from wheretolook.utils.texts import LOG
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:
    from wheretolook.localization.shard import SceneJob


NOT_SCENES = ("weights", "results", "adapted", "all")  # other folders of a dataset, and the name of all scenes


@dataclass(frozen=True)
class MeshSource:
    """A scene from a mesh file.

    Args:
        path: GLB, PLY or OBJ file with textures, in metres, or a Habitat-Matterport folder `<id>-<name>`.
        split: where its viewpoints go: train, val or test.
        name: of the scene; the file's own name if empty.
        up: which axis of the file points up: x, y or z, with a minus sign if it points down.
    """

    path: Path
    split: Literal["train", "val", "test"] = "test"
    name: str = ""
    up: str = "z"

    def __post_init__(self) -> None:
        check_folder_name("a scene's name", self.scene_name, NOT_SCENES)

    @property
    def scene_name(self) -> str:
        """Name of the scene's folder."""
        return self.name or self.path.stem


@dataclass(frozen=True)
class ScenesConfig:
    """Settings of the scenes stage.

    Args:
        train: generated scenes to learn from.
        val: generated scenes for validation; with none, some locations of the training scenes are held out.
        test: generated scenes to evaluate on.
        seed: seed of the first generated scene; each further one counts up.
        kinds: kinds of generated scenes in turn: a seed's kind is `kinds[seed % len(kinds)]`. `apartment`, `hall`,
            `court`, `office` or `building`, in which rooms repeat and are mapped in part. All but apartments without
            `vary` draw their sizes and difficulty from the seed.
        apartment: options of apartments, and the texture and light of all generated scenes.
        meshes: scenes from existing meshes, in addition to generated ones, such as [{path: scans/office.glb}].
    """

    train: int = 3
    val: int = 0
    test: int = 1
    seed: int = 0
    kinds: tuple[SceneKind, ...] = ("apartment",)
    apartment: ApartmentConfig = field(default_factory=ApartmentConfig)
    meshes: tuple[MeshSource, ...] = ()

    def __post_init__(self) -> None:
        counts = (self.train, self.val, self.test)
        unknown = {*self.kinds} - {*get_args(SceneKind)}
        reject(
            (min(counts) < 0, "numbers of scenes must be at least 0", counts),
            (sum(counts) + len(self.meshes) == 0, "set scenes.train, scenes.test or scenes.meshes", counts),
            (not self.kinds or bool(unknown), f"scenes.kinds are some of {get_args(SceneKind)}", self.kinds),
        )

    def kind_of(self, seed: int) -> SceneKind:
        """Return the kind of the generated scene of a seed."""
        return self.kinds[seed % len(self.kinds)]


T = TypeVar("T")

Log = Callable[[str], None]
"""Receives one line about what a command has finished."""

Progress = Callable[[float], None]
"""Receives the work finished since the last call: 1 for each scene, or 1 for a command that does not loop over scenes."""


def ignore_progress(work: float) -> None:
    """Do nothing: for callers that show no progress."""


OUTPUTS = ("out", "floor_plan", "figure", "record", "film", "nav2")
"""Options that are paths to write; all other paths are inputs."""


def _checking_outputs(run: Callable[..., T]) -> Callable[..., T]:
    @wraps(run)
    def checked(command: Any, *args: Any, **kwargs: Any) -> T:
        if getattr(command, "mesh_up", "z") != "z" and command.mesh is None:
            raise ConfigError("--mesh-up states the axis of a mesh", value=command.mesh_up, fix="Give --mesh.")
        options = list(_texts(command))
        inputs = [Path(text) for name, text in options if name not in OUTPUTS and os.path.exists(text)]
        for name, text in options:
            if name in OUTPUTS:
                check_output(Path(text), inputs)
                inputs.append(Path(text))
            if name == "out" and command.WRITES:
                check_output_folder(Path(text), (Path(text) / command.WRITES).is_file())
        return run(command, *args, **kwargs)

    return checked


def _texts(options: Any) -> Iterator[tuple[str, str | Path]]:
    """Yield the name of each option, also in groups, that is a path, or a text that may name a file, and its value."""
    for option in fields(options):
        value = getattr(options, option.name)
        if is_dataclass(value):
            yield from _texts(value)
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, Path) or (isinstance(text, str) and os.path.isfile(text)):
                yield option.name, text


@dataclass(frozen=True, kw_only=True)
class Command:
    """Base of all commands."""

    CONFIG: ClassVar[str] = ""
    """Bundled configuration that is read unless `--config` names another, such as demo."""
    SHORT: ClassVar[Mapping[str, str]] = {}
    """Shorter names of options, as the command line writes them, without `--`."""
    GROUPS: ClassVar[Mapping[str, str]] = {}
    """What precedes the names of options in a field that is a dataclass, if it is not the field's name and a point."""
    POSITIONAL: ClassVar[str] = "config"
    """Option of the values before the first option."""
    WRITES: ClassVar[str] = ""
    """If `out` is a folder: a file in it, by which the command knows a folder that it wrote."""
    LISTING: ClassVar[str] = ""
    """Option with which the command prints a list and does nothing else."""

    def __init_subclass__(cls) -> None:
        """Let the command's `run` check its outputs first, and collect the `GROUPS` of its bases."""
        cls.GROUPS = {name: text for base in cls.__mro__[::-1] for name, text in vars(base).get("GROUPS", {}).items()}
        if "run" in vars(cls):
            cls.run = _checking_outputs(cls.run)  # type: ignore[method-assign]

    def run(self) -> Any:
        """Do the command's work."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class DatasetOptions(Command):
    """Which dataset a command works on, and where it computes.

    Args:
        name: name of the dataset and its folder.
        data: folder of all datasets.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
        camera: the camera of the viewpoints; it also maps unless `mapping.camera` names another.
    """

    name: str = "demo"
    data: Path = Path("data")
    device: str = "auto"
    camera: CameraConfig = field(default_factory=CameraConfig)

    def __post_init__(self) -> None:
        check_device_name(self.device)
        safe_child(self.data, self.name, "a dataset's name")
        if not isinstance(self.camera, CameraConfig):  # in Python a camera itself is accepted
            object.__setattr__(self, "camera", CameraConfig.of(self.camera))

    @property
    def root(self) -> Path:
        """Folder of the dataset."""
        return self.data / self.name

    @property
    def warp_device(self) -> str:
        """The device that kernels run on, with "auto" resolved. Raises ConfigError if there is no such device."""
        return usable_device(self.device)


@dataclass(frozen=True, kw_only=True)
class SceneOptions(DatasetOptions):
    """How the scenes of a dataset are read.

    Args:
        occlusion: how occluded landmarks are recognized.
        free_space: positions that a camera may take.
        mapped_space: the same in a scene of photographs, which has no mesh.
        extractor: keypoints of maps. Of an existing map, only its weights count, if they have moved since it was made.
    """

    GROUPS: ClassVar = {
        "free_space": "scenes.free_space.",
        "mapped_space": "scenes.mapped_space.",
        "extractor": "mapping.extractor.",
    }

    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)
    free_space: FreeSpaceConfig = field(default_factory=FreeSpaceConfig)
    mapped_space: MappedSpaceConfig = field(default_factory=MappedSpaceConfig)
    extractor: ExtractorConfig = field(default_factory=ExtractorConfig)


@dataclass(frozen=True, kw_only=True)
class LabelOptions(DatasetOptions):
    """How views are rendered and localized.

    Args:
        label: localization, and the processes that run it.
    """

    label: LabelConfig = field(default_factory=LabelConfig)

    @property
    def n_workers(self) -> int:
        """Worker processes: `label.workers`, by default one for each CPU core that this process may use."""
        return self.label.workers or cores()

    @property
    def warp_device(self) -> str:
        """The device that kernels run on. Not checked for a Ray cluster: only its machines know their devices."""
        if self.label.engine == "ray" and self.device != "auto":
            return self.device
        return usable_device(self.device)


@dataclass(frozen=True, kw_only=True)
class Experiment(SceneOptions, LabelOptions):
    """Options of all stages from scenes to labels.

    Args:
        scenes: meshes.
        mapping: COLMAP maps of meshes or of photographs.
        sample: viewpoints and which landmarks they see.
        tracking: where MLflow keeps its runs.
    """

    scenes: ScenesConfig = field(default_factory=ScenesConfig)
    mapping: MapConfig = field(default_factory=MapConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


def select_options(command: type[T], options: object, **given: Any) -> T:
    """Return a command with the given options, and those of its others that another command's options include."""
    names = [field.name for field in fields(command) if hasattr(options, field.name)]  # type: ignore[arg-type]
    return command(**{**{name: getattr(options, name) for name in names}, **given})


@dataclass(frozen=True, kw_only=True)
class CameraOptions(Command):
    """The camera of the views.

    Args:
        camera: COLMAP's MODEL,width,height,parameters, such as PINHOLE,640,480,320,320,320,240; or a file: ROS's
            camera_info, OpenCV's calibration (YAML), nerfstudio's transforms.json. By default the map's.
        camera_id: instead, the camera_id of one of the map's cameras.
    """

    camera: str | None = None
    camera_id: int | None = None

    def named_camera(self) -> Camera | int | None:
        """Return the camera asked for: one, a camera_id of the map, or None for the map's own."""
        if self.camera is not None and self.camera_id is not None:
            raise ConfigError("the camera is described in several ways", value=self.camera, fix="Give one of them.")
        return self.camera_id if self.camera is None else read_camera(self.camera)


@dataclass(frozen=True, kw_only=True)
class MaskOptions(Command):
    """A mask for Nav2.

    Args:
        nav2: also write masks for the costmap filters of Nav2, from the best score at each place: a folder.
        camera_z: of the camera in a world in metres with z up, for those masks.
    """

    nav2: Path | None = None
    camera_z: float | None = None


@dataclass(frozen=True, kw_only=True)
class MeshOptions(Command):
    """A mesh of a map's scene.

    Args:
        mesh: a mesh of the map's scene (GLB, OBJ, PLY) in its frame.
        mesh_up: which axis of the mesh's file is the map's z: x, y or z, with a minus sign if it points down.
    """

    mesh: Path | None = None
    mesh_up: str = "z"


@dataclass(frozen=True, kw_only=True)
class ScorerOptions(MeshOptions):
    """How views are scored.

    Args:
        occlusion: mesh, tsdf (depth images), hidden-points (from the landmarks alone) or none; by default the first of
            these that there is data for.
        weights: file or folder of weights, or their name on the Hugging Face hub; by default the bundled ones.
        method: a name of `wheretolook evaluate --list-methods`; by default that of the weights.
        accuracy: limits of the errors in metres and degrees that scores refer to; by default those of the weights,
            0.05,0.4. In a map of unknown unit, metres are those of a median depth of 5 m.
        anywhere: allow weights adapted to another scene.
    """

    occlusion: str | None = None
    weights: Path | None = None
    method: str = ""
    accuracy: tuple[float, float] | None = None
    anywhere: bool = False


def load_dataset(
    options: DatasetOptions, required_stage: str, exempt: Callable[[SceneFolder], bool] = lambda scene: False
) -> Dataset:
    """Load a command's dataset, and check that a stage has been run on the present input of each scene but exempt ones.

    Raises ConfigError if it was made with another camera, or is a release where meshes and maps are needed; TableError
    if it does not exist, or the stage has not been run.
    """
    _ = options.warp_device  # a missing GPU is an error now, not after hours of other work
    dataset = Dataset.load(options.root)
    if required_stage != "label":
        refuse_release(options.root)
    wanted = options.camera.camera
    unnamed = options.camera == CameraConfig()
    others = [scene.camera for scene in dataset.scenes if scene.camera != wanted and not (scene.own_camera and unnamed)]
    if others:
        fix = "Run the scenes stage with this configuration, or give another --name."
        problem = "the dataset was made with another camera"
        raise ConfigError(problem, path=options.root, value=others[0], fix=fix)
    for scene in dataset.scenes:
        if scene.stage_cache(required_stage).stored_key is None and not exempt(scene):
            problem = f"`wheretolook {required_stage}` has not been run for this scene since its input was made"
            raise TableError(problem, path=scene.folder, fix=f"Run `wheretolook {required_stage}`.")
    return dataset


def open_scene(options: SceneOptions, files: SceneFolder) -> Scene:
    """Return a scene of the dataset with a command's occlusion, free space and device; nothing is read yet."""
    scene = Scene(files, None, options.occlusion, options.free_space, options.mapped_space, options.device)
    if files.own_camera:
        camera = f"the camera of its map, {describe_camera(files.camera)}"
        LOG.info("%s: %s", files.name, "; ".join((camera, *scene.frame.doubts)))
    return scene


def refuse_release(root: Path) -> None:
    """Raise ConfigError if a folder holds a release."""
    if (root / RELEASE_FILE).is_file():
        problem = "a release has no meshes and maps, and would be lost if they were made again"
        fix = "Use it with train, evaluate and release only, or give another --name."
        raise ConfigError(problem, path=root, fix=fix)


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Add a file's path to errors of code that knows only its content."""
    try:
        yield
    except (SceneError, MapError, TableError) as error:
        if error.path is not None:
            raise
        raise type(error)(error.problem, path=path, value=error.value, fix=error.fix) from error


def extractor_of(scene: SceneFolder, given: ExtractorConfig | None = None) -> ExtractorConfig:
    """Return the keypoint extractor that the map was made with; queries must use the same.

    `given`, if of the same method, names the weights where they have moved. Raises MapError without the map's report, or
    if its landmarks have no descriptors to match queries with; WeightsError if the weights are missing.
    """
    path = scene.map / "report.json"
    try:
        report = read_json_object(path)
        extractor = from_record(ExtractorConfig, report["config"]["extractor"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise MapError("the map's report is missing or damaged", path=path, fix="Run the map stage again.") from error
    if not report.get("has_descriptors", True):
        fix = "Run the map stage again with --database, or with --images to triangulate again."
        raise MapError("the landmarks have no descriptors, so nothing can be localized", path=scene.map, fix=fix)
    if given is not None and given.weights and given.method == extractor.method:
        extractor = replace(extractor, weights=given.weights)
    if extractor.weights and not Path(extractor.weights).is_file():
        fix = f"Give their new path: --mapping.extractor.method {extractor.method} --mapping.extractor.weights FILE."
        raise WeightsError("the weights that this map was made with are missing", path=extractor.weights, fix=fix)
    return extractor


def scene_job(files: SceneFolder, label: LabelConfig, extractor: ExtractorConfig, device: str) -> SceneJob:
    """Return what workers need to label viewpoints of a scene on a device, with keypoints of the map's extractor."""
    from wheretolook.localization.shard import SceneJob

    cameras = tuple(files.cameras().items()) if files.cameras_file.is_file() else ()
    return SceneJob(
        files.mesh,
        files.landmarks,
        files.camera,
        label.localizer,
        extractor,
        device,
        cameras=cameras,
        appearance=label.appearance,
    )


def existing(path: Path, error: type[SceneError] | type[MapError], stage: str) -> str:
    """Return the fingerprint of a file that a stage makes; raise `error`, naming the stage, without the file."""
    if not path.is_file():
        raise error("this file is missing", path=path, fix=f"Run the {stage} stage first.")
    return fingerprint(path)


def mesh_fingerprint(path: Path) -> str:
    """Return sizes and dates of a mesh and the files next to it. Raises SceneError if there is no mesh."""
    if not path.exists():
        raise SceneError("there is no such mesh", path=path, fix="Check the path.")
    files = [path]
    if path.is_dir() or path.suffix.lower() != ".glb":  # materials and textures are files next to it
        folder = path if path.is_dir() else path.parent
        files = sorted(file for file in folder.iterdir() if file.is_file())
    return " ".join(f"{file.resolve()}:{file.stat().st_size}:{file.stat().st_mtime_ns}" for file in files)
