"""A scene of the release as figures show it: its mesh made anew from the seed, its map, its viewpoints, what they see.

A release has no meshes. An apartment follows from the release's settings and the seed in the scene's name; that it is
the one that was labelled shows in its occlusion, which must be what the release has stored.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.dataset.scene_occlusion import scene_occlusion
from wheretolook.figures.house_image import Dollhouse, dollhouse
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, direction_lattice
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.release.copy import ABOUT
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.procedural.generator import ApartmentConfig, generate_apartment
from wheretolook.space.free_space import FreeSpace, FreeSpaceConfig
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.viewpoints.sampling import SampleConfig, free_locations
from wheretolook.viewpoints.table import is_good
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.occlusion import OcclusionModel, StoredOcclusion

EYE_M = 1.45
"""Height of the locations that figures show, unless told otherwise: about that of the mapping cameras."""

SAME_OCCLUSION = 0.999
"""Share of the lines of sight that must be as stored; what differs is rounding."""

_CHECKED = 16  # locations whose lines of sight are compared

_SEEDED = re.compile(r"apartment-(\d+)")


@dataclass(frozen=True, eq=False)
class Showcase:
    """A scene with everything that figures ask for.

    Attributes:
        scene: its files.
        mesh: metres, z up.
        space: where a camera can be.
        localization_map: with the mesh's occlusion, so that it answers for any location.
        table: its viewpoints.
        grid: of its locations.
        free: ids of the locations in free space, (L,) ascending.
        directions: (D, 3) unit optical axes that each location was looked from.
        keep: K, the directions that the paper keeps of each location.
    """

    scene: SceneFolder
    mesh: TexturedMesh
    space: FreeSpace
    localization_map: LocalizationMap
    table: pd.DataFrame
    grid: VoxelGrid
    free: NDArray[np.int64]
    directions: Float
    keep: int = 100

    @cached_property
    def renderer(self) -> WarpRenderer:
        """Renders the mesh."""
        return WarpRenderer(self.mesh, self.localization_map.device)

    @cached_property
    def house(self) -> Dollhouse:
        """The scene obliquely from above, cut at the height of eyes."""
        return dollhouse(self.mesh, cut_m=self._floor + EYE_M, device=self.localization_map.device)

    @cached_property
    def plan(self) -> Dollhouse:
        """The scene from straight above."""
        return dollhouse(self.mesh, elevation_deg=90, device=self.localization_map.device)

    @property
    def camera(self) -> PinholeCamera:
        """Intrinsics of every viewpoint."""
        camera = self.localization_map.camera
        assert isinstance(camera, PinholeCamera)
        return camera

    @property
    def _floor(self) -> float:
        return float(self.mesh.bounds[0, 2])

    def render(self, cam_from_world: ArrayLike) -> NDArray[np.uint8]:
        """What cameras (B, 3, 4) see, (B, H, W, 3)."""
        return self.renderer.render(self.camera, cam_from_world).rgb

    def layer(self, height_m: float = EYE_M) -> NDArray[np.int64]:
        """Ids of all voxels, free or not, of the layer that holds a height above the floor, (nx ny,)."""
        nz = self.grid.shape[2]
        z = (self._floor + height_m - self.grid.lower[2]) / self.grid.voxel_m[2]
        ids = np.arange(len(self.grid))
        return ids[ids % nz == np.clip(int(z), 0, nz - 1)]

    def center(self, location_id: int) -> Float:
        """(3,) metres, of a location."""
        return self.grid.centers()[location_id]

    def nearest_location(self, point: ArrayLike) -> int:
        """The location with viewpoints that is nearest to a world point (3,) m."""
        ids = np.unique(self.table["location_id"].to_numpy(np.int64))
        apart = np.linalg.norm(self.grid.centers()[ids] - np.asarray(point, dtype=np.float64), axis=1)
        return int(ids[np.argmin(apart)])

    def summary(self) -> str:
        """How much of everything there is, as a sentence."""
        one, n_locations = self.localization_map, self.table["location_id"].nunique()
        cameras = "" if one.mapping_poses is None else f" of {len(one.mapping_poses)} images"
        return (
            f"**{self.scene.name}**: {len(self.mesh.triangles):,} triangles; a map{cameras} with "
            f"{len(one.landmarks):,} landmarks; {len(self.table):,} labelled viewpoints at {n_locations} locations, of "
            f"which {is_good(self.table).mean():.0%} localize."
        )

    def viewpoints(self, location_id: int) -> pd.DataFrame:
        """Rows of the table at a location.

        Raises:
            ConfigError: it has none.
        """
        rows = self.table[self.table["location_id"] == location_id]
        if len(rows) == 0:
            fix = "Take one of the table's location_id."
            raise ConfigError("no viewpoint was sampled at this location", value=location_id, fix=fix)
        return rows

    def instructive_location(self, height_m: float = EYE_M) -> int:
        """The location of a layer where the share of viewpoints that localize is nearest to one half: where to look
        matters there. Of several, the first; if the layer has no viewpoint, one of any height.
        """
        rows = self.table[self.table["location_id"].isin(self.layer(height_m))]
        ids, shares = shares_good(rows if len(rows) else self.table)
        return int(ids[np.argmin(np.abs(shares - 0.5))])


def open_showcase(dataset: Dataset, name: str | None = None, device: str = "cpu") -> Showcase:
    """A scene of a release of generated apartments.

    Args:
        dataset: the release.
        name: of the scene; None takes the first test scene.
        device: where kernels run.

    Raises:
        ConfigError: it is no release, or has no such scene. SceneError: the scene was not generated from a seed, or
            what this code makes of the seed is not the scene that was labelled.
    """
    about = dataset.root / ABOUT
    if not about.is_file():
        raise ConfigError(
            "this dataset is no release", path=dataset.root, fix="Open one that `wheretolook release` made."
        )
    settings = json.loads(about.read_text())["settings"]
    scene = dataset.scene(name) if name else (*dataset.split("test"), *dataset.scenes)[0]
    seeded = _SEEDED.fullmatch(scene.name)
    if seeded is None:
        raise SceneError("this scene was not generated from a seed", path=scene.folder, value=scene.name)
    apartment = ApartmentConfig(**settings["scenes"]["apartment"])
    mesh = generate_apartment(apartment, int(seeded[1]), device=device)
    space = FreeSpace(mesh, FreeSpaceConfig(**settings["scenes"]["free_space"]), device)
    sampling = SampleConfig(**settings["sample"])
    grid = VoxelGrid.over(space.bounds, sampling.grid)
    landmarks = Landmarks.load(scene.landmarks)
    rays = OcclusionConfig(**{**settings["occlusion"], "model": "mesh"})
    occlusion = scene_occlusion(scene, dataset.camera, rays, device, mesh, space.two_sided)
    if settings["occlusion"]["model"] == "mesh":
        _check_same(scene, landmarks, occlusion)
    directions = direction_lattice(sampling.directions, sampling.lattice)
    localization_map = LocalizationMap(landmarks, dataset.camera, occlusion, device, scene.mapping_poses())
    return Showcase(
        scene, mesh, space, localization_map, scene.read_table(), grid, free_locations(grid, space), directions,
        sampling.keep or SampleConfig().keep,
    )  # fmt: skip


def shares_good(table: pd.DataFrame) -> tuple[NDArray[np.int64], Float]:
    """Ids (L,) of a table's locations, ascending, and the share of each one's viewpoints that localize, (L,)."""
    ids, rows = np.unique(table["location_id"].to_numpy(np.int64), return_inverse=True)
    return ids, np.bincount(rows, weights=is_good(table)) / np.bincount(rows)


def _check_same(scene: SceneFolder, landmarks: Landmarks, occlusion: OcclusionModel) -> None:
    """Raise a SceneError if lines of sight are not those stored."""
    stored = StoredOcclusion.load(scene.occlusion)
    some = stored.locations[:: max(1, len(stored.locations) // _CHECKED)]
    same = (occlusion.unoccluded(some, landmarks.points) == stored.unoccluded(some, landmarks.points)).mean()
    if not same >= SAME_OCCLUSION:
        raise SceneError(
            "made anew from its seed, the scene is not the one that was labelled", path=scene.folder,
            value=f"{same:.1%} of the lines of sight are as stored",
            fix="Check out the version of the code that release.json names.",
        )  # fmt: skip
