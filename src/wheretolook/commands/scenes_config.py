"""Options of the scenes command."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from wheretolook.scans.config import RgbdConfig
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.space.config import FreeSpaceConfig, MappedSpaceConfig
from wheretolook.utils.confine import check_folder_name
from wheretolook.utils.validation import reject

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
        rgbd: an RGB-D recording to make one scene of. With its folder no other scene is made; existing scenes of the
            dataset remain.
        free_space: positions that a camera may take.
        mapped_space: the same in a scene of photographs, which has no mesh, or in a scan, which is incomplete.
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
