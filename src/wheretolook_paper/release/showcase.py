"""A scene of the release with its mesh generated again from the seed, and the data of its figures.

A release has no meshes. An apartment follows from the release's settings and the seed in the scene's name; its
occlusion must equal the stored one, or it is not the scene that was labelled.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property, partial
from typing import NamedTuple, cast, get_args

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.sampling import free_locations
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float, poses_looking_along, rotation_looking_along
from wheretolook.geometry.views import Views
from wheretolook.inputs.channels import CHANNELS
from wheretolook.planning.config import PlanConfig
from wheretolook.planning.scene_map import path_views, plan_by_methods
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.mlp.network import BinnedNetworkScorer
from wheretolook.space.config import FreeSpaceConfig
from wheretolook.utils.errors import SceneError, from_record
from wheretolook.visibility.config import OcclusionConfig
from wheretolook.visibility.counting import Survey, SurveyOptions, survey
from wheretolook.visibility.frustum import pixels_of
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.figures.dollhouse import Dollhouse, dollhouse
from wheretolook_paper.figures.network import BinnedImage, spread_extrema
from wheretolook_paper.figures.overview import View, instructive_location, outcome_in_words, rendered_views
from wheretolook_paper.figures.pipeline import Pipeline
from wheretolook_paper.figures.sampling import Sampling
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.path_comparison import draw_pairs
from wheretolook_paper.release.copy import read_about
from wheretolook_paper.release.mlp_architecture import activations
from wheretolook_rooms.generator import generate_scene

EYE_M = 1.45  # height of the shown locations above the floor, about that of the mapping cameras


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
    free_space = from_record(FreeSpaceConfig, settings["scenes"]["free_space"])
    kind = cast(SceneKind, seeded[1])
    apartment = from_record(ApartmentConfig, settings["scenes"]["apartment"])
    mesh, _ = generate_scene(kind, apartment, int(seeded[2]))
    showcase = Showcase(scene, None, occlusion, free_space)
    showcase.mesh = mesh
    showcase.sampling = from_record(SampleConfig, settings["sample"])
    if settings["occlusion"]["model"] == "mesh":
        _check_same(showcase)
    return showcase


def _check_same(scene: Scene) -> None:
    """Raise a SceneError if lines of sight differ from the stored ones."""
    stored = StoredOcclusion.load(scene.folder.occlusion)
    points = scene.landmarks.points
    some = stored.locations[:: max(1, len(stored.locations) // 16)]  # locations whose lines of sight are compared
    same = (scene.occlusion.unoccluded(some, points) == stored.unoccluded(some, points)).mean()
    if not same >= 0.999:  # required share of equal lines of sight; rounding may differ
        problem = f"generated from its seed, only {same:.1%} of the lines of sight are as in the labelled scene"
        fix = "Check out the version of the code that release.json names."
        raise SceneError(problem, path=scene.folder.folder, fix=fix)


class Peaks(NamedTuple):
    """Arguments of `peaks_figure`."""

    directions: Float
    scores: Float
    peaks: tuple[View, ...]
    pits: tuple[View, ...]
    tried: tuple[Float, NDArray[np.bool_]]


class Learning(NamedTuple):
    """Arguments of `learning_figure`."""

    image: BinnedImage
    activations: tuple[Float, ...]
    channels: tuple[str, ...]
    outcome: str


def pipeline_of(showcase: Showcase, scorer: Scorer, location_id: int) -> Pipeline:
    """Return the steps from the scene's map to the best labelled view of a location.

    At each location at eye height, only the K directions with the most visible landmarks are
    scored (paper, Sec. 3.2), by a scorer whose scores are probabilities.
    """
    localization_map = showcase.localization_map
    locations = showcase.grid.centers()[np.intersect1d(showcase.layer(), showcase.free)]
    kept = _survey(showcase, locations).best
    looking = poses_looking_along(np.repeat(locations, kept.shape[1], axis=0), showcase.directions[kept.ravel()])
    scores = scorer.score(looking).reshape(kept.shape)
    best = np.take_along_axis(kept, scores.argmax(1)[:, None], axis=1)[:, 0]
    candidates = showcase.viewpoints(location_id)
    candidate_scores = scorer.score(poses(candidates))
    row = int(np.argmax(candidate_scores))
    chosen = poses(candidates.iloc[[row]])
    seen = np.zeros(len(localization_map.landmarks), dtype=bool)
    seen[localization_map.landmarks_in_view(chosen)[0]] = True
    return Pipeline(
        house=showcase.house,
        landmarks=localization_map.landmarks.points,
        mapping_poses=np.zeros((0, 3, 4)) if localization_map.mapping_poses is None else localization_map.mapping_poses,
        camera=showcase.camera,
        locations=locations,
        n_locations=len(showcase.free),
        n_directions=len(showcase.directions),
        best_axes=showcase.directions[best],
        best_scores=scores.max(1),
        chosen=chosen[0],
        chosen_score=float(candidate_scores[row]),
        seen=seen,
        rgb=showcase.render(chosen)[0],
        outcome=outcome_in_words(candidates.iloc[row]),
    )


def sampling_of(showcase: Showcase, location_id: int) -> Sampling:
    """Return the layer of voxels of a location, and the landmarks visible and unoccluded from there."""
    localization_map = showcase.localization_map
    place = showcase.center(location_id)
    nz = showcase.grid.shape[2]
    layer = np.arange(location_id % nz, len(showcase.grid), nz)
    in_view = _survey(showcase, place[None])
    kept = np.zeros(len(showcase.directions), dtype=bool)
    best = in_view.best[0]
    kept[best[in_view.counts[0, best] > 0]] = True
    return Sampling(
        plan=showcase.plan,
        grid=showcase.grid,
        layer=layer,
        free=np.isin(layer, showcase.free),
        place=place,
        directions=showcase.directions,
        n_visible=in_view.counts[0].astype(np.int64),
        kept=kept,
        landmarks=localization_map.landmarks.points,
        unoccluded=localization_map.occlusion.unoccluded(place[None], localization_map.landmarks.points)[0],
    )


def binned_image_of(showcase: Showcase, cam_from_world: ArrayLike, bins: int = 30) -> BinnedImage:
    """Render and bin the view of a pose cam_from_world (3, 4)."""
    localization_map = showcase.localization_map
    pose = np.asarray(cam_from_world, dtype=np.float64)[None]
    points = localization_map.landmarks.points[localization_map.landmarks_in_view(pose)[0]]
    pixels = pixels_of(showcase.camera, points @ pose[0, :, :3].T + pose[0, :, 3])
    binned = localization_map.bin_views(pose, bins)
    empty = binned.counts[0] == 0
    means = {name: np.where(empty, np.nan, binned.means[0, row]) for row, name in enumerate(CHANNELS)}
    return BinnedImage(showcase.render(pose)[0], pixels, means, binned.counts[0])


def learning_of(showcase: Showcase, scorer: BinnedNetworkScorer, location_id: int, best: bool = True) -> Learning:
    """Return the activations of the paper's network for the best, or the worst, labelled view of a location."""
    candidates = showcase.viewpoints(location_id)
    row = int((np.argmax if best else np.argmin)(scorer.score(poses(candidates))))
    pose = poses(candidates.iloc[[row]])
    spec = scorer.network.spec
    found = activations(scorer.network, showcase.localization_map.bin_views(pose, spec.bins))
    image = binned_image_of(showcase, pose[0], spec.bins)
    return Learning(image, tuple(found), spec.channels, outcome_in_words(candidates.iloc[row], brief=True))


def mistaken_location(showcase: Showcase, scorer: Scorer) -> int:
    """Return the location at eye height with the largest mean difference between predictions and labels."""
    rows = showcase.table[showcase.table["location_id"].isin(showcase.layer())]
    error = pd.Series(np.abs(scorer.score(poses(rows)) - is_good(rows)), rows["location_id"])
    means = error.groupby(level=0).mean()
    return int(means.index[int(means.to_numpy().argmax())])


def peaks_of(showcase: Showcase, scorer: Scorer, location_id: int, n: int = 3) -> Peaks:
    """Return the scores of all directions at a location, and its n labelled views with the highest and lowest scores.

    Scores must be probabilities.
    """
    rows = showcase.viewpoints(location_id)
    looked = poses(rows)
    scores = scorer.score(poses(rows))
    axes = looked[:, 2, :3]

    def views(highest: bool) -> tuple[View, ...]:
        found = spread_extrema(axes, scores, n, highest=highest)
        return rendered_views(showcase, rows.iloc[found], scores[found], partial(outcome_in_words, brief=True))

    known = (rows["status"] != UNLABELLED).to_numpy()
    center = np.broadcast_to(showcase.center(location_id), showcase.directions.shape)
    everywhere = scorer.score(poses_looking_along(center, showcase.directions))
    tried = axes[known], is_good(rows[known])
    return Peaks(showcase.directions, everywhere, views(True), views(False), tried)


def planned_views(
    showcase: Showcase,
    dataset: Dataset,
    methods: Sequence[str] = PathsConfig.methods,
    config: PlanConfig = PlanConfig(grid=(8, 8, 4), directions=200),
) -> dict[str, Views]:
    """Return the views along several methods' paths between the farthest of ten random pairs."""
    pairs = draw_pairs(showcase.space, PathsConfig(pairs=10))
    start, goal = pairs[np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1).argmax()]
    paths = plan_by_methods(showcase, dataset, methods, start, goal, config)
    return {name: path_views(path, showcase.localization_map) for name, path in paths.items()}


def _survey(showcase: Showcase, locations: Float) -> Survey:
    rotations = rotation_looking_along(showcase.directions)
    points = showcase.landmarks.points
    options = SurveyOptions(keep=showcase.keep, keep_occlusion=False, device=showcase.device)
    return survey(showcase.camera, rotations, locations, points, showcase.occlusion, options)
