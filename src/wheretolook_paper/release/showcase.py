"""A scene of the release for figures, with its mesh generated again from the seed.

A release has no meshes. An apartment follows from the release's settings and the seed in the scene's name; its
occlusion must equal the stored one, or it is not the scene that was labelled.
"""

from __future__ import annotations

import re
from functools import cached_property
from typing import cast, get_args

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.sampling import free_locations
from wheretolook.dataset.sampling_config import SampleConfig
from wheretolook.dataset.scene import Scene, SceneConfig
from wheretolook.dataset.viewpoint_table import is_good
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.space.config import FreeSpaceConfig
from wheretolook.utils.errors import SceneError, from_record
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.figures.dollhouse import Dollhouse, dollhouse
from wheretolook_paper.figures.overview import instructive_location
from wheretolook_paper.release.copy import read_about
from wheretolook_rooms.generator import generate_scene

EYE_M = 1.45  # height of the shown locations above the floor, about that of the mapping cameras
SAME_OCCLUSION = 0.999  # required share of equal lines of sight; rounding may differ

_CHECKED = 16  # locations whose lines of sight are compared

_SEEDED = re.compile(rf"({'|'.join(get_args(SceneKind))})-(\d+)")


class Showcase(Scene):
    """A scene of a release with everything that figures need; occlusion is by its mesh."""

    sampling: SampleConfig  # how its viewpoints were sampled

    @cached_property
    def table(self) -> pd.DataFrame:
        """The scene's viewpoints."""
        return self.folder.read_table()

    @cached_property
    def grid(self) -> VoxelGrid:
        """Voxels whose centres are the locations."""
        return self.sampling.voxels(self.space.bounds)

    @cached_property
    def free(self) -> NDArray[np.int64]:
        """Ids of the locations in free space, (L,) ascending."""
        return free_locations(self.grid, self.space)

    @cached_property
    def directions(self) -> Float:
        """Optical axes sampled at each location, (D, 3) unit vectors."""
        return self.sampling.axes()

    @property
    def keep(self) -> int:
        """K, the number of directions that the paper keeps at each location."""
        return self.sampling.keep or SampleConfig().keep

    @cached_property
    def house(self) -> Dollhouse:
        """The scene from above at an angle, cut at eye height."""
        return dollhouse(self.mesh, cut_m=self._floor + EYE_M, device=self.device)

    @cached_property
    def plan(self) -> Dollhouse:
        """The scene from straight above."""
        return dollhouse(self.mesh, elevation_deg=90, device=self.device)

    @property
    def _floor(self) -> float:
        return float(self.mesh.bounds[0, 2])

    def render(self, cam_from_world: ArrayLike) -> NDArray[np.uint8]:
        """Render the views of cameras (B, 3, 4), (B, H, W, 3)."""
        return self.renderer.render(self.camera, cam_from_world).rgb

    def layer(self) -> NDArray[np.int64]:
        """Return the ids (nx ny,) of all voxels of the layer at eye height."""
        nz = self.grid.shape[2]
        z = (self._floor + EYE_M - self.grid.lower[2]) / self.grid.voxel_m[2]
        ids = np.arange(len(self.grid))
        return ids[ids % nz == np.clip(int(z), 0, nz - 1)]

    def center(self, location_id: int) -> Float:
        """Return the centre (3,) m of a location."""
        return self.grid.centers()[location_id]

    def nearest_location(self, point: ArrayLike) -> int:
        """Return the location with viewpoints nearest to a world point (3,) m."""
        ids = np.unique(self.table["location_id"].to_numpy(np.int64))
        apart = np.linalg.norm(self.grid.centers()[ids] - np.asarray(point, dtype=np.float64), axis=1)
        return int(ids[np.argmin(apart)])

    def summary(self) -> str:
        """Describe the scene's sizes in a sentence."""
        n_locations = self.table["location_id"].nunique()
        good = is_good(self.table).mean()
        cameras = "" if self.map.mapping_poses is None else f" of {len(self.map.mapping_poses)} images"
        return (
            f"**{self.name}**: {len(self.mesh.triangles):,} triangles; a map{cameras} with "
            f"{len(self.landmarks):,} landmarks; {len(self.table):,} labelled viewpoints at {n_locations} locations, "
            f"of which {good:.0%} localize."
        )

    def viewpoints(self, location_id: int) -> pd.DataFrame:
        """Return the rows of the table at a location."""
        return self.table[self.table["location_id"] == location_id]

    def instructive_location(self) -> int:
        """Return the location at eye height where the choice of view matters most; of any height if none has a view."""
        rows = self.table[self.table["location_id"].isin(self.layer())]
        return instructive_location(rows if len(rows) else self.table)


def open_showcase(dataset: Dataset, name: str | None = None) -> Showcase:
    """Open a scene of a release of generated apartments, by default the first test scene.

    Raises:
        ConfigError: the description of the release is missing or damaged, or it has no such scene.
        SceneError: the scene was not generated from a seed, or the seed gives another scene than the labelled one.
    """
    settings = read_about(dataset)["settings"]
    scene = dataset.scene(name) if name else (*dataset.split("test"), *dataset.scenes)[0]
    seeded = _SEEDED.fullmatch(scene.name)
    if seeded is None:
        raise SceneError("this scene was not generated from a seed", path=scene.folder, value=scene.name)
    occlusion = from_record(OcclusionConfig, {**settings["occlusion"], "model": "mesh"})
    config = SceneConfig(occlusion, from_record(FreeSpaceConfig, settings["scenes"]["free_space"]))
    kind = cast(SceneKind, seeded[1])
    apartment = from_record(ApartmentConfig, settings["scenes"]["apartment"])
    mesh, _ = generate_scene(kind, apartment, int(seeded[2]))
    showcase = Showcase(scene, None, config, "cpu", mesh=mesh)
    showcase.sampling = from_record(SampleConfig, settings["sample"])
    if settings["occlusion"]["model"] == "mesh":
        _check_same(showcase)
    return showcase


def _check_same(scene: Scene) -> None:
    """Raise a SceneError if lines of sight differ from the stored ones."""
    stored = StoredOcclusion.load(scene.folder.occlusion)
    points = scene.landmarks.points
    some = stored.locations[:: max(1, len(stored.locations) // _CHECKED)]
    same = (scene.occlusion.unoccluded(some, points) == stored.unoccluded(some, points)).mean()
    if not same >= SAME_OCCLUSION:
        problem = f"generated from its seed, only {same:.1%} of the lines of sight are as in the labelled scene"
        fix = "Check out the version of the code that release.json names."
        raise SceneError(problem, path=scene.folder.folder, fix=fix)
