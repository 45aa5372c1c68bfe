"""Scores photographs that were left out, by any methods, on the maps without them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.evaluation.photographs import score_scale
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.holdout.holdout import LeftOut
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import compact_poses
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import find, make_scorer
from wheretolook.training.weights import method_of_weights
from wheretolook.utils.errors import MapWarning, OutOfRangeWarning
from wheretolook.visibility.cached_occlusion import CachedOcclusion
from wheretolook.visibility.occlusion import OcclusionModel
from wheretolook.weights.resolve import load_scorer, resolve_weights

VISIBLE = "visible"  # the method that all are compared with: its score here is the number of landmarks in view


@dataclass(frozen=True)
class Scoring:
    """The method that is checked, and others beside it."""

    method: str = ""  # "" for that of the weights
    weights: Path | None = None  # file or folder; None for those that ship
    also: tuple[str, ...] = ()
    anywhere: bool = False  # whether weights that are adapted to another place may score

    def check(self) -> None:
        """Raise a WeightsError if weights are missing or damaged, of any of the methods."""
        for weights in (self.chosen, *(resolve_weights(name) for name in self.also)):
            if weights is not None:
                method_of_weights(weights)

    @property
    def chosen(self) -> Path | None:
        """The file of weights of the method that is checked, on a map by SIFT."""
        return self.chosen_for("")

    def chosen_for(self, features: str) -> Path | None:
        """The file of weights of the method that is checked, on a map by some features."""
        return resolve_weights(self.method, self.weights, features)

    def scorer(self, localization_map: LocalizationMap) -> Scorer:
        """The scorer that is checked."""
        chosen = self.chosen_for(localization_map.landmarks.features)
        if self.method:
            return make_scorer(self.method, localization_map, weights=chosen, anywhere=self.anywhere)
        return load_scorer(str(chosen), localization_map, anywhere=self.anywhere)


def check_place(source: PhotographedMap, scoring: Scoring, device: str) -> None:
    """Raise a WeightsError if the weights are adapted to another place than the whole map, unless that may be.

    Without a block a map may lack most of the landmarks by which they would know it.
    """
    chosen = scoring.chosen
    method = find(method_of_weights(chosen)) if chosen is not None else None
    if method is not None and method.one_place and not scoring.anywhere:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MapWarning)
            landmarks = load_colmap_landmarks(source.path, reconstruction=source.model, progress=False)
        scoring.scorer(LocalizationMap(landmarks, source.cameras[0], device=device))


def score_views(
    source: PhotographedMap, left_out: Sequence[LeftOut], scoring: Scoring, occlusion: OcclusionModel, device: str
) -> tuple[str, pd.DataFrame]:
    """The name of the method that is checked, and the views of all blocks with what it tells of them.

    The views of `LeftOut` have further columns: block, is_part, score, expected_inliers (NaN where the method does not
    tell), n_visible, in_range, `visible` (n_visible once more), and one for each method beside. Scores of methods that
    give a share of the map's landmarks are times their number: blocks have maps of different sizes.
    """
    parts = []
    name = ""
    with tqdm(total=sum(len(one.views) for one in left_out), desc="check: score", unit="view") as bar:
        for one in left_out:
            views = one.views.copy()
            columns: dict[str, Float] = {}
            for rows, around in maps_without(source, one, occlusion, device):
                found = _score(around, source.poses[views["row"].to_numpy()[rows]], scoring)
                name = found.pop("name")
                for column, values in found.items():
                    columns.setdefault(column, np.full(len(views), np.nan))[rows] = values
                bar.update(len(rows))
            views = views.assign(**columns, block=one.block.number, is_part=one.block.is_part)
            parts.append(views.astype({"in_range": bool, "n_visible": np.int64}))
    return name, pd.concat(parts, ignore_index=True)


def maps_without(
    source: PhotographedMap, one: LeftOut, occlusion: OcclusionModel, device: str
) -> Iterator[tuple[NDArray[np.int64], LocalizationMap]]:
    """The map without a block as each camera of its photographs looks at it, and the rows of the block's views."""
    kept = np.setdiff1d(np.arange(len(source.poses)), one.block.left_out)
    hides = occlusion if occlusion.name == "none" else CachedOcclusion(occlusion)
    looking = [source.cameras[row] for row in one.views["row"]]
    around = LocalizationMap(one.landmarks, looking[0], hides, device, compact_poses(source.poses[kept]))
    for camera, rows in _by_camera(looking):
        yield rows, around.of_camera(camera)


def _by_camera(cameras: Sequence[Camera]) -> list[tuple[Camera, NDArray[np.int64]]]:
    rows: dict[Camera, list[int]] = {}
    for row, camera in enumerate(cameras):
        rows.setdefault(camera, []).append(row)
    return [(camera, np.array(found)) for camera, found in rows.items()]


def _score(around: LocalizationMap, poses: Float, scoring: Scoring) -> dict[str, Any]:
    scorer = _quietly(replace(scoring, anywhere=True).scorer, around)  # `check_place` has seen to it
    told = _quietly(scorer.report, poses)
    found: dict[str, Any] = {"name": scorer.name, "score": told.score * score_scale(scorer.name, around)}
    found |= {"expected_inliers": told.expected_inliers, "n_visible": told.n_visible, "in_range": told.in_range}
    found[VISIBLE] = told.n_visible
    for other in scoring.also:
        if other not in (VISIBLE, scorer.name):
            beside = make_scorer(other, around, weights=resolve_weights(other, features=around.landmarks.features))
            found[other] = _quietly(beside.score, poses) * score_scale(other, around)
    return found


def _quietly(call: Callable[..., Any], *arguments: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OutOfRangeWarning)  # the results tell how many are in range
        return call(*arguments)
