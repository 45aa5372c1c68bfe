"""Extend maps of a few photographs by others of the same set: policies against each other.

    python -m wheretolook_paper.studies.extend_photographs --map work/kitchen/map \
      --features work/kitchen/photographs/database.db --work work/extend --out extend.csv

Of a map of photographs, consecutive ones are the present map, as of a walk, and those that each policy chooses of the
rest are added. What none chooses is localized, with the keypoints of the map's features; truth are the whole map's
poses. The surface is known from the landmarks of the present map alone. Limits of errors are shares of depth, 1 % and
5 %, where the scale is unknown.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from numpy.typing import NDArray

from wheretolook.extend.audit import Audit
from wheretolook.extend.plan import Planner
from wheretolook.features.extractor import Keypoints
from wheretolook.geometry.poses import Float
from wheretolook.geometry.views import Views
from wheretolook.holdout.holdout import without
from wheretolook.holdout.photo_map import MAX_ERROR_M, PhotographedMap, open_map
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.colmap_model import write_model
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook_paper.evaluation.comparison import replace_rows
from wheretolook_paper.studies.extend import error_of, row_of, spread

Rows = NDArray[np.int64]


class Photographs:
    """A map of photographs, of which parts are made into maps of their own."""

    def __init__(self, source: PhotographedMap) -> None:
        self.source = source
        self.kind, self.stored = read_features(source.features, source.names)
        self.order = np.argsort(source.names)

    def reduced(self, rows: Rows) -> Any:
        """Return a `pycolmap.Reconstruction` of some photographs (rows) alone."""
        ids = self.source.arrays.image_ids
        return without(self.source.model, np.delete(ids, rows).tolist())

    def errors(self, rows: Rows, tested: Rows) -> Float:
        """Return errors (T, 2) of tested photographs in a map of others, scaled so that one limit serves all."""
        source = self.source
        with warnings.catch_warnings(action="ignore", category=MapWarning):
            landmarks = load_colmap_landmarks(
                source.path, source.features, None, "cpu", self.reduced(rows), progress=False
            )
        localizer = Localizer(landmarks, source.cameras[0])
        errors = []
        for row in tested.tolist():
            pixels, descriptors = self.stored[row]
            keypoints = Keypoints(pixels, self.kind.restore(descriptors))
            error = error_of(localizer, keypoints, source.poses[row], source.cameras[row])
            errors.append(error * (MAX_ERROR_M / source.limit_m[row], 1))
        return np.array(errors)

    def planner(self, folder: Path, base: Rows, rest: Rows) -> Planner:
        """Return a planner of a map of some photographs, whose candidates and target views are the others."""
        write_model(self.reduced(base), folder)
        look = WhereToLook.from_colmap(folder, database=self.source.features, device="cpu", scale=1, up="z")
        poses = self.source.poses[rest]
        places = np.arange(len(rest))
        names = tuple(str(place) for place in places)
        targets = Views(poses, look.localization_map.camera, look.scorer.name, waypoint=places, waypoint_id=names)
        return Planner(look.scorer, look.space, look.audit(Audit(targets.in_frame(look.frame), 1.0)).views, poses)

    def rows_of(self, poses: Float) -> Rows:
        """Return the photographs at poses (I, 3, 4)."""
        return np.abs(self.source.poses[None] - poses[:, None]).sum(axis=(2, 3)).argmin(axis=1)


def main(
    map: Path,
    features: Path,
    work: Path,
    out: Path,
    name: str = "",
    images: int = 30,
    n: int = 10,
    draws: int = 6,
    least_p: float = 0.3,
) -> None:
    """Extend parts of the map by each policy, localize the other photographs, and write a row for each draw and policy.

    Args:
        map: folder of a COLMAP model of photographs.
        features: COLMAP database or hloc's HDF5 file of their features.
        work: folder of the present maps.
        out: CSV file of the results.
        name: name of the scene; by default the map's.
        images: photographs of the present map.
        n: photographs that are added.
        draws: present maps, which begin at different photographs.
        least_p: least probability that one of a pair registers.
    """
    photographs = Photographs(open_map(map, features, name))
    for draw in range(draws):
        order = np.roll(photographs.order, -draw * len(photographs.order) // draws)
        base, rest = order[:images], np.sort(order[images:])
        with warnings.catch_warnings(action="ignore", category=MapWarning):
            planner = photographs.planner(work / f"{photographs.source.name}-{draw}", base, rest)
        added: dict[str, Rows] = {"none": base[:0], "walk": order[images : images + n]}
        for policy in ("random", "even", "worst"):
            added[policy] = photographs.rows_of(spread(policy, planner, n, draw))
        plan: dict[str, Any] = {"predicted": np.nan, "p_registers": (), "seconds": 0.0}
        plans = dict.fromkeys(added, plan) | {"none": plan | {"predicted": planner.targets.score.mean()}}
        try:
            extension = planner.plan(n, least_p)
        except MapError as error:
            print(f"{photographs.source.name} {draw}: {error}")
            continue
        to_world = planner.scorer.localization_map.frame.world_from_map
        added["pairs"] = photographs.rows_of(to_world.apply_to_poses(extension.views.cam_from_world))
        plans["pairs"] = plan | {"predicted": extension.predicted.mean(), "p_registers": extension.views.p_registers}
        tested = np.setdiff1d(rest, np.concatenate([*added.values()]))
        records = []
        for policy, rows in added.items():
            errors = photographs.errors(np.concatenate([base, rows]), tested)
            so_far = range(len(plans[policy]["p_registers"]))
            registered = [
                photographs.errors(np.concatenate([base, rows[:number]]), rows[[number]])[0] for number in so_far
            ]
            record = {"scene": photographs.source.name, "seed": draw, "policy": policy, "added": len(rows)}
            records.append(record | row_of(plans[policy], errors, registered))
            print({name: records[-1][name] for name in (*record, "views", "strict", "coarse", "predicted")}, flush=True)
        replace_rows(out, pd.DataFrame(records).round(4), ["scene", "seed", "policy"])


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
