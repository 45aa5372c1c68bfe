"""Which parts of a map relocalize badly, so that they should be photographed again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from wheretolook.holdout.holdout import LeftOut
from wheretolook.holdout.holdout_blocks import observation_matrix
from wheretolook.holdout.photo_map import PhotographedMap

ALIKE = 0.2
"""Two photographs show the same part if they share this much of the landmarks of the one that has fewer."""


@dataclass(frozen=True, eq=False)
class WeakPart:
    """Neighbouring photographs that do not localize without their block."""

    number: int  # from 1, the one with most such photographs first
    rows: NDArray[np.int64]  # of these photographs
    n_tested: int  # they, and photographs that localize although most of what they show is the same
    n_left_out: int  # photographs in the largest block that they were left out with
    n_kept: float  # landmarks that the rest of the map has of what they show, of the median one
    center: tuple[float, float, float]  # median of their camera centres, in the model's own frame and unit
    target: tuple[float, float, float]  # median of what they look at, the same way

    def describe(self, names: list[str], unit: str) -> str:
        """One sentence."""
        listed = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        near, look = (" ".join(f"{value:.2f}" for value in place) for place in (self.center, self.target))
        verb = "does" if len(self.rows) == 1 else "do"
        others = f"{self.n_left_out - 1} neighbours" if self.n_left_out > 2 else "their neighbour"
        return (
            f"near ({near}) {unit}, looking at ({look}): {len(self.rows)} of {self.n_tested} {verb} not localize "
            f"without {others}, as the rest of the map has {self.n_kept:.0f} landmarks of what they show: {listed}"
        )


def weak_parts(source: PhotographedMap, left_out: list[LeftOut], views: pd.DataFrame) -> list[WeakPart]:
    """Groups of photographs that fail, by the blocks that share out all photographs: each was left out once in these.

    Those that share landmarks are one part (`ALIKE`). The one with most photographs comes first.
    """
    tested = views[views["is_part"]]
    rows = tested["row"].to_numpy()
    good = tested["good"].to_numpy(dtype=bool)
    if good.all():
        return []
    sees = observation_matrix(source)
    at = sees[source.moment[rows]]
    shared = np.asarray((at @ at.T).toarray())
    own = np.maximum(np.diag(shared), 1)
    alike = shared >= ALIKE * np.minimum(own[:, None], own)
    bad = np.flatnonzero(~good)
    _, label = connected_components(alike[np.ix_(bad, bad)], directed=False)
    sizes = {one.block.number: len(one.block.left_out) for one in left_out}
    points = source.arrays.points
    back = source.from_model
    parts = []
    for group in np.unique(label):
        members = bad[label == group]
        around = alike[members].any(0)
        around[members] = True
        seen = np.flatnonzero(np.asarray(at[members].sum(0)).reshape(-1))
        target = (np.median(points[seen], axis=0) - back.translation) @ back.rotation / back.scale
        own_rows = rows[members]
        parts.append(
            WeakPart(
                number=0,
                rows=own_rows,
                n_tested=int(around.sum()),
                n_left_out=max(sizes[block] for block in tested["block"].to_numpy()[members]),
                n_kept=float(np.median(tested["n_kept"].to_numpy()[members])),
                center=tuple(np.median(source.own_centers[own_rows], axis=0).tolist()),
                target=tuple(target.tolist()),
            )
        )
    parts.sort(key=lambda part: (-len(part.rows), int(part.rows[0])))
    return [WeakPart(**{**vars(part), "number": number}) for number, part in enumerate(parts, 1)]
