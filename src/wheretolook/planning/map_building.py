"""Building viewpoint maps from a localization map and any scorer, and bringing them up to date."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.colmap_camera import Camera, ColmapCamera
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float, rotation_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.methods.base import Scorer
from wheretolook.planning.refine import score_directions
from wheretolook.planning.viewpoint_map import MapOrigin, ViewpointMap
from wheretolook.utils.errors import ConfigError, MapError, SceneError
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook.visibility.survey import survey

VIEWS_AT_ONCE = 16_384
"""Views handed to the scorer at a time, whole locations: enough for a GPU, and the progress bar moves."""

SIGHT_BYTES = 1 << 28
"""Lines of sight asked for at a time in an update."""

MAX_DIRECTIONS = 1 << 16
"""Ids of directions are stored in 16 bits."""

SAME_SCORE = 1e-4
"""Scores of a voxel computed again may differ by this much, absolute or relative: networks sum in another order."""


def build_viewpoint_map(
    scorer: Scorer,
    grid: VoxelGrid,
    free: ArrayLike,
    directions: ArrayLike,
    lattice: str = "",
    progress: str | None = None,
) -> ViewpointMap:
    """Score every direction at the centre of every free voxel.

    Args:
        scorer: any method; it knows its map, and so landmarks, camera, occlusion and device.
        grid: voxels of the world.
        free: where a camera can be: ids of voxels, (L,), such as `viewpoints.sampling.free_locations` finds, or a mask
            of all voxels, (V,) bool.
        directions: (D, 3) optical axes in the world, of any length, such as `direction_lattice` gives.
        lattice: their name, to be told to readers.
        progress: text of progress bars; None shows none.

    Raises:
        SceneError: no voxel is free, or the centre of one lies inside geometry.
        MapError: the map has no landmarks, or one whose position is not finite.
        ConfigError: more than 65,536 directions, ids outside the grid, or neither ids nor a mask of its voxels.
        ValueError: directions of another shape, or such that have no direction.
    """
    axes = _unit(directions)
    rows = _ids(free, len(grid))
    if len(rows) == 0:
        raise SceneError("no voxel is free", value=len(grid), fix="Refine the grid, or check where it lies.")
    if rows[0] < 0 or rows[-1] >= len(grid):
        raise ConfigError("ids of free voxels lie outside the grid", value=(int(rows[0]), int(rows[-1])))
    _check_landmarks(scorer.localization_map.landmarks)
    row_of_voxel = np.full(len(grid), -1, dtype=np.int32)
    row_of_voxel[rows] = np.arange(len(rows))
    ranked, scores, n_visible = _score_and_count(scorer, grid.centers()[rows], axes, progress)
    one = scorer.localization_map
    digests = landmark_digests(one.landmarks)
    return ViewpointMap(
        grid, row_of_voxel, axes, ranked, scores, n_visible, one.landmarks.ids, digests,
        _origin(scorer, lattice, digests),
    )  # fmt: skip


def update_viewpoint_map(
    old: ViewpointMap, scorer: Scorer, progress: str | None = None
) -> tuple[ViewpointMap, NDArray[np.int64]]:
    """The viewpoint map of a map to which landmarks were added, equal to one built anew.

    Landmarks are compared by id. Voxels with a free line of sight to one that is new, or whose attributes have changed,
    are scored again. This is all that can change if scores depend on no other landmarks (`Scorer.local`) and landmarks
    do not hide one another (`OcclusionModel.landmarks_hide`). Otherwise, and if landmarks were removed or moved, all
    voxels are scored again. What stands in the scene must be the same: where it changed, build anew.

    Args:
        old: made with the same method, camera and occlusion.
        scorer: the method on the new map.
        progress: text of progress bars; None shows none.

    Returns:
        The new map; the old one stays as it is. And the ids of the voxels that were scored again. Where networks score,
        the numbers equal those of a new build up to rounding.

    Raises:
        ConfigError: the map was derived from another; the method, camera or occlusion model is another; or the scores
            or counts of a voxel that should not have changed did, so that weights or geometry must be others.
        SceneError, MapError: as in `build_viewpoint_map`.
    """
    one = scorer.localization_map
    if old.origin.derived:
        raise ConfigError(
            "a viewpoint map derived from another cannot be updated", value=old.origin.derived,
            fix="Update the one it was derived from, and derive it again.",
        )  # fmt: skip
    _check_landmarks(one.landmarks)
    digests = landmark_digests(one.landmarks)
    origin = _origin(scorer, old.origin.lattice, digests)
    for name in ("scorer", "camera", "occlusion"):
        if getattr(origin, name) != getattr(old.origin, name):
            raise ConfigError(
                f"the viewpoint map was built with another {name}", value=getattr(origin, name),
                fix=f"Use {getattr(old.origin, name)!r}, or build it anew.",
            )  # fmt: skip
    changed = _changed_landmarks(old, one.landmarks, digests)
    if changed is None or one.occlusion.landmarks_hide or not scorer.local:
        seen = np.ones(len(old.scores), dtype=bool)
    else:
        seen = _which_see(one, old.locations, changed)
        _check_unchanged(old, scorer, np.flatnonzero(~seen)[:1])
    ranked, scores, n_visible = old.ranked.copy(), old.scores.copy(), old.n_visible.copy()
    if seen.any():
        again = _score_and_count(scorer, old.locations[seen], old.directions, progress)
        ranked[seen], scores[seen], n_visible[seen] = again
    new = replace(
        old, ranked=ranked, scores=scores, n_visible=n_visible, landmark_ids=one.landmarks.ids,
        landmark_digests=digests, origin=origin,
    )  # fmt: skip
    return new, old.voxel_of_row[seen]


def landmark_digests(landmarks: Landmarks) -> NDArray[np.uint64]:
    """Digests (N, 2) of each landmark's position and of what else scorers are told about it.

    A digest is the first 8 bytes of BLAKE2b, little-endian.
    """
    attributes = np.concatenate([landmarks.mapping_direction, landmarks.attributes()], axis=1)
    return np.stack([_digests(landmarks.points), _digests(attributes)], axis=1)


def _digests(rows: NDArray[Any]) -> NDArray[np.uint64]:
    rows = np.ascontiguousarray(rows)
    found = b"".join(hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows)
    return np.frombuffer(found, dtype="<u8").astype(np.uint64)


def _score_and_count(
    scorer: Scorer, locations: Float, directions: Float, progress: str | None
) -> tuple[NDArray[np.uint16], NDArray[np.float32], NDArray[np.uint32]]:
    """Ranked ids, scores and visible counts, each (L, D), of all directions at locations (L, 3) m."""
    one = scorer.localization_map
    counted = survey(
        one.camera, rotation_looking_along(directions), locations, one.landmarks.points, one.occlusion,
        keep=1, keep_occlusion=False, device=one.device, progress=progress and f"{progress}: count",
    )  # fmt: skip
    ranked = np.empty((len(locations), len(directions)), dtype=np.uint16)
    scores = np.empty(ranked.shape, dtype=np.float32)
    block = max(1, VIEWS_AT_ONCE // len(directions))
    with tqdm(
        total=len(locations), desc=progress and f"{progress}: score", unit="voxel", disable=progress is None
    ) as bar:
        for begin in range(0, len(locations), block):
            rows = slice(begin, begin + block)
            values = score_directions(scorer, locations[rows], directions)
            ranked[rows] = np.argsort(-values, axis=1, kind="stable")
            scores[rows] = values
            bar.update(len(values))
    return ranked, scores, counted.counts.astype(np.uint32)


def _ids(free: ArrayLike, n_voxels: int) -> NDArray[np.int64]:
    """Ids of free voxels, ascending, each once, of ids or a mask."""
    given = np.asarray(free)
    if given.dtype == bool:
        if given.shape != (n_voxels,):
            raise ConfigError("a mask of free voxels has a value for each voxel", value=given.shape,
                              fix=f"Give one of shape ({n_voxels},), in the order of VoxelGrid.centers.")  # fmt: skip
        return np.flatnonzero(given)
    if given.size and not np.issubdtype(given.dtype, np.integer):
        raise ConfigError("free voxels are given by ids or a mask", value=str(given.dtype),
                          fix="Give integers, or a boolean for each voxel.")  # fmt: skip
    return np.unique(given.astype(np.int64))


def _check_landmarks(landmarks: Landmarks) -> None:
    bad = np.flatnonzero(~np.isfinite(landmarks.points).all(axis=1))
    if len(bad):
        raise MapError(
            f"the position of landmark {landmarks.ids[bad[0]]} is not finite",
            value=tuple(landmarks.points[bad[0]].tolist()), fix="Remove it, or run the map stage again.",
        )  # fmt: skip


def _unit(directions: ArrayLike) -> Float:
    axes = np.asarray(directions, dtype=np.float64)
    if axes.ndim != 2 or axes.shape[1] != 3 or len(axes) == 0:
        raise ValueError(f"directions must have shape (D, 3), got {axes.shape}")
    if len(axes) > MAX_DIRECTIONS:
        raise ConfigError(f"a viewpoint map holds at most {MAX_DIRECTIONS:,} directions", value=len(axes))
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    if not np.all((length > 0) & (length < np.inf)):
        raise ValueError("directions must be finite and of some length")
    return np.where(np.abs(length - 1) < 1e-12, axes, axes / length)  # those of a lattice stay as they are


def _changed_landmarks(
    old: ViewpointMap, landmarks: Landmarks, digests: NDArray[np.uint64]
) -> NDArray[np.int64] | None:
    """Rows of landmarks that are new or have other attributes; None if some were removed or moved."""
    place = np.searchsorted(landmarks.ids, old.landmark_ids)
    place = np.minimum(place, max(0, len(landmarks) - 1))
    kept = len(landmarks) > 0 and np.array_equal(landmarks.ids[place], old.landmark_ids)
    if not kept or not np.array_equal(digests[place, 0], old.landmark_digests[:, 0]):
        return None
    same = np.zeros(len(landmarks), dtype=bool)
    same[place] = digests[place, 1] == old.landmark_digests[:, 1]
    return np.flatnonzero(~same)


def _which_see(one: LocalizationMap, locations: Float, landmarks: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which locations (L, 3) m have a free line of sight to at least one of these rows of the map's landmarks; (L,)."""
    points = one.landmarks.points
    everything = isinstance(one.occlusion, StoredOcclusion)  # which answers for its whole map only
    asked = points if everything else points[landmarks]
    columns = landmarks if everything else slice(None)
    seen = np.zeros(len(locations), dtype=bool)
    if len(landmarks) == 0:
        return seen
    block = max(1, SIGHT_BYTES // len(asked))
    for begin in range(0, len(locations), block):
        rows = slice(begin, begin + block)
        seen[rows] = one.occlusion.unoccluded(locations[rows], asked)[:, columns].any(axis=1)
    return seen


def _check_unchanged(old: ViewpointMap, scorer: Scorer, rows: NDArray[np.int64]) -> None:
    """A voxel that sees nothing new tells whether weights and geometry are those of the old map."""
    if len(rows) == 0:
        return
    _, scores, n_visible = _score_and_count(scorer, old.locations[rows], old.directions, None)
    if not np.array_equal(n_visible, old.n_visible[rows]) or not np.allclose(
        scores, old.scores[rows], rtol=SAME_SCORE, atol=SAME_SCORE
    ):
        raise ConfigError(
            "a voxel that sees none of the added landmarks has other scores or counts than in the viewpoint map",
            value=tuple(np.round(old.locations[rows[0]], 3).tolist()),
            fix="Weights, or what stands in the scene, must have changed: build it anew.",
        )


def _origin(scorer: Scorer, lattice: str, digests: NDArray[np.uint64]) -> MapOrigin:
    one = scorer.localization_map
    digest = hashlib.sha256(one.landmarks.ids.tobytes() + digests.tobytes())
    return MapOrigin(scorer.name, lattice, _intrinsics(one.camera), one.occlusion.name, digest.hexdigest()[:16])


def _intrinsics(camera: Camera) -> dict[str, Any]:
    """As COLMAP describes a camera."""
    if isinstance(camera, ColmapCamera):
        model, params = camera.model, camera.params
    else:
        model, params = "PINHOLE", (camera.focal_px, camera.focal_px, camera.cx, camera.cy)
    values = [float(value) for value in params]
    return {"model": model, "width": camera.width, "height": camera.height, "params": values}
