"""Find the parts of a map that relocalize badly, so that they should be photographed again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from wheretolook.holdout.holdout import HoldoutResult
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.mapping.colmap_model import observation_matrix

MIN_SHARED = 0.2
"""Two photographs show the same part if they share this fraction of the landmarks of the one that has fewer."""


@dataclass(frozen=True, eq=False)
class WeakPart:
    """Neighbouring photographs that do not localize without their block.

    Attributes:
        number: from 1, the part with most such photographs first.
        rows: of these photographs.
        n_tested: number of these, and of photographs that localize although they mostly show the same.
        n_left_out: photographs in the largest block that they were held out with.
        n_kept: landmarks that the rest of the map still has of those they observe, for the median photograph.
        center: median of their camera centres, in the model's own frame and unit.
        target: median of the landmarks they observe, likewise.
    """

    number: int
    rows: NDArray[np.int64]
    n_tested: int
    n_left_out: int
    n_kept: float
    center: tuple[float, float, float]
    target: tuple[float, float, float]

    def record(self, names: list[str]) -> dict[str, Any]:
        """JSON values; photographs by their names."""
        record = {**vars(self), "photographs": [names[row] for row in self.rows]}
        del record["rows"]
        return record

    def describe(self, names: list[str], unit: str) -> str:
        """Describe the part in one sentence."""
        listed = ", ".join(names[row] for row in self.rows[:4])
        if len(self.rows) > 4:
            listed += f" and {len(self.rows) - 4} more"
        near, look = (" ".join(f"{value:.2f}" for value in place) for place in (self.center, self.target))
        return (
            f"near ({near}) {unit}, looking at ({look}): {len(self.rows)} of {self.n_tested} photographs fail to "
            f"localize without their block of {self.n_left_out}; the rest of the map has {self.n_kept:.0f} of the "
            f"landmarks they show: {listed}"
        )


def weak_parts(source: PhotographedMap, results: list[HoldoutResult], views: pd.DataFrame) -> list[WeakPart]:
    """Group the photographs that fail in the blocks that partition all photographs; those that share landmarks join."""
    tested = views[views["is_part"]]
    rows = tested["row"].to_numpy()
    good = tested["good"].to_numpy(dtype=bool)
    if good.all():
        return []
    observes = observation_matrix(source.arrays, source.frame)[source.frame[rows]]
    shared = np.asarray((observes @ observes.T).toarray())
    counts = np.maximum(np.diag(shared), 1)
    alike = shared >= MIN_SHARED * np.minimum(counts[:, None], counts)
    bad = np.flatnonzero(~good)
    _, label = connected_components(alike[np.ix_(bad, bad)], directed=False)
    sizes = {one.block.number: len(one.block.held_out) for one in results}
    to_frame = source.from_model
    parts = []
    for group in np.unique(label):
        members = bad[label == group]
        same_part = alike[members].any(0)
        same_part[members] = True
        observed = np.flatnonzero(np.asarray(observes[members].sum(0)).reshape(-1))
        target = np.median(source.arrays.points[observed], axis=0)
        target = (target - to_frame.translation) @ to_frame.rotation / to_frame.scale
        parts.append(
            WeakPart(
                number=0,
                rows=rows[members],
                n_tested=int(same_part.sum()),
                n_left_out=max(sizes[block] for block in tested["block"].to_numpy()[members]),
                n_kept=float(np.median(tested["n_kept"].to_numpy()[members])),
                center=tuple(np.median(source.own_centers[rows[members]], axis=0).tolist()),
                target=tuple(target.tolist()),
            )
        )
    parts.sort(key=lambda part: (-len(part.rows), int(part.rows[0])))
    return [replace(part, number=number) for number, part in enumerate(parts, 1)]
