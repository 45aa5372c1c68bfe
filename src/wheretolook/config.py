"""One experiment: every stage's settings in one frozen dataclass, read from one YAML file."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from wheretolook.dataset.sampling_config import SampleConfig
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.figures.config import FiguresConfig
from wheretolook.geometry.camera import CameraConfig
from wheretolook.localization.config import LabelConfig
from wheretolook.mapping.config import MapConfig
from wheretolook.planning.config import PathsConfig, PlanConfig, ViewpointMapConfig
from wheretolook.scans.config import RgbdConfig
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.scorers.adapted.config import AdaptConfig
from wheretolook.scorers.train_config import MOVED as MOVED_TRAIN_OPTIONS
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.space.config import FreeSpaceConfig, MappedSpaceConfig
from wheretolook.tracking.config import TrackingConfig
from wheretolook.utils.confine import check_folder_name, safe_child
from wheretolook.utils.devices import check_device_name, usable_device
from wheretolook.utils.errors import ConfigError
from wheretolook.visibility.config import OcclusionConfig

NOT_SCENES = (
    "weights",
    "results",
    "adapted",
    "all",
)  # folders of a dataset that are no scenes, and what all scenes are called


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
        kinds: kinds of generated scenes, one after the other in turn: a seed's is `kinds[seed % len(kinds)]`. Beside
            `apartment` there are `hall`, `court`, `office` and `building`, in which rooms repeat that are mapped in
            part. These draw their sizes and difficulty from the seed, as apartments do that `vary`.
        apartment: what an apartment is like, and the texture and light of all generated scenes.
        meshes: scenes from meshes of one's own, beside the generated ones, such as [{path: scans/office.glb}].
        rgbd: an RGB-D recording to make one scene of. With its folder no other scene is made; those that the dataset
            has are kept.
        free_space: where a camera may be.
        mapped_space: where it may be in a scene of photographs, which has no mesh, or in a scan, which is in parts.
    """

    train: int = 3
    val: int = 0
    test: int = 1
    seed: int = 0
    kinds: tuple[SceneKind, ...] = ("apartment",)
    apartment: ApartmentConfig = field(default_factory=ApartmentConfig)
    meshes: tuple[MeshSource, ...] = ()
    rgbd: RgbdConfig = field(default_factory=RgbdConfig)
    free_space: FreeSpaceConfig = field(default_factory=FreeSpaceConfig)
    mapped_space: MappedSpaceConfig = field(default_factory=MappedSpaceConfig)

    def __post_init__(self) -> None:
        if min(self.train, self.val, self.test) < 0 or self.train + self.val + self.test + len(self.meshes) == 0:
            fix = "Set scenes.train and scenes.test, or name meshes in scenes.meshes."
            value = (self.train, self.val, self.test, self.meshes)
            raise ConfigError("an experiment needs scenes", value=value, fix=fix)
        if not self.kinds or not set(self.kinds) <= set(get_args(SceneKind)):
            fix = f"Name some of {', '.join(get_args(SceneKind))}."
            raise ConfigError("scenes.kinds are kinds of generated scenes", value=self.kinds, fix=fix)

    def kind_of(self, seed: int) -> SceneKind:
        """The kind of the generated scene of a seed."""
        return self.kinds[seed % len(self.kinds)]


@dataclass(frozen=True)
class Experiment:
    """Settings of all stages. Each stage reads what it needs; results lie in `<data>/<name>/`.

    Args:
        name: name of the dataset and its folder.
        data: folder of all datasets.
        release_name: folder of the dataset's release.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
        camera: the camera that will look, and that maps unless `map.camera` names another.
        scenes: stage 1, meshes.
        map: stage 2, COLMAP maps, of meshes or of photographs.
        occlusion: how stage 3 finds out which landmarks are unoccluded. Stage 6 takes the settings of occlusion models,
            but not their names, from here; these are `evaluate.occlusions`.
        sample: stage 3, viewpoints and what they see.
        label: stage 4, localization errors.
        train: stage 5, what is learnt from the labels.
        evaluate: stage 6, scores of all methods.
        adapt: weights adapted to one scene.
        viewpoint_map: what planners query.
        plan: one path to plan.
        paths: planned paths of several methods, to be compared.
        figures: of the paper and others, drawn from runs.
        tracking: where MLflow keeps its runs.
    """

    name: str = "demo"
    data: Path = Path("data")
    release_name: str = "release"
    device: str = "auto"
    camera: CameraConfig = field(default_factory=CameraConfig)
    scenes: ScenesConfig = field(default_factory=ScenesConfig)
    map: MapConfig = field(default_factory=MapConfig)
    occlusion: OcclusionConfig = field(default_factory=OcclusionConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    label: LabelConfig = field(default_factory=LabelConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    adapt: AdaptConfig = field(default_factory=AdaptConfig)
    viewpoint_map: ViewpointMapConfig = field(default_factory=ViewpointMapConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    paths: PathsConfig = field(default_factory=PathsConfig)
    figures: FiguresConfig = field(default_factory=FiguresConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def __post_init__(self) -> None:
        check_device_name(self.device)
        safe_child(self.data, self.name, "a dataset's name")
        check_folder_name("a release's name", self.release_name)
        safe_child(self.data, self.release_name, "a release's name")
        if not isinstance(self.camera, CameraConfig):  # from Python, a camera itself may be given
            object.__setattr__(self, "camera", CameraConfig.of(self.camera))

    @property
    def root(self) -> Path:
        """Folder of the dataset."""
        return self.data / self.name

    @property
    def n_workers(self) -> int:
        """Worker processes: as `label.workers` says, by default one for each CPU core this process may use."""
        return self.label.workers or len(os.sched_getaffinity(0))

    @property
    def warp_device(self) -> str:
        """The device kernels run on, with "auto" resolved.

        Raises ConfigError if there is no such device here. With a Ray cluster a name is not checked:
        only its machines know which devices they have.
        """
        if self.label.engine == "ray" and self.device != "auto":
            return self.device
        return usable_device(self.device)


MOVED: dict[str, str] = {**MOVED_TRAIN_OPTIONS}
"""Options there were, and where they have gone: the name of another option, or a sentence."""
