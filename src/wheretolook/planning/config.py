"""Settings of the viewpoint map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wheretolook.errors import ConfigError
from wheretolook.grid import Lattice


@dataclass(frozen=True)
class ViewpointMapConfig:
    """What a viewpoint map is made of.

    Args:
        scene: name of the scene's folder; empty for all scenes of the dataset.
        method: that scores the views, see `wheretolook evaluate --list-methods`; empty for the one that the weights are
            of, or bins if there are none.
        weights: file of weights that the train stage wrote, for a method that has learnt. Unless a method is named,
            the best of the dataset, or else of the release, for cameras with their field of view.
        out: folder to write; empty for `<data>/<name>/<scene>/viewpoint-map`. Only with a scene.
        grid: voxels along x, y and z over the scene's bounds.
        directions: directions at each voxel.
        lattice: how they are spread: fibonacci is even; yaw-pitch are ActLoc's 6 x 18, whatever `directions` says.
    """

    scene: str = ""
    method: str = ""
    weights: Path | None = None
    out: Path | None = None
    grid: tuple[int, int, int] = (8, 8, 8)
    directions: int = 500
    lattice: Lattice = "fibonacci"

    def __post_init__(self) -> None:
        if self.out is not None and not self.scene:
            raise ConfigError("viewpoint_map.out is the folder of one scene", value=str(self.out), fix="Name a scene.")
