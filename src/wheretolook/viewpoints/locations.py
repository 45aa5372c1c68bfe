"""What the labels of a table say about its locations."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.viewpoints.table import is_good


def shares_good(table: pd.DataFrame) -> tuple[NDArray[np.int64], Float]:
    """Ids (L,) of a table's locations, ascending, and the share of each one's viewpoints that localize, (L,)."""
    ids, rows = np.unique(table["location_id"].to_numpy(np.int64), return_inverse=True)
    return ids, np.bincount(rows, weights=is_good(table)) / np.bincount(rows)


def instructive_location(table: pd.DataFrame) -> int:
    """The location where the share of viewpoints that localize is nearest to one half: where to look matters there.

    Of several, the first.
    """
    ids, shares = shares_good(table)
    return int(ids[np.argmin(np.abs(shares - 0.5))])
