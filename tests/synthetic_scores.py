"""Score tables with all columns, made up."""

import numpy as np
import pandas as pd

from wheretolook.dataset.config import THRESHOLDS, threshold_key
from wheretolook.evaluation.results import RELEASED_DIVISOR

KEYS = tuple(map(threshold_key, THRESHOLDS))
FISHER = tuple(
    f"fisher-{metric}-{approximation}"
    for metric in ("mineig", "logdet", "trace")
    for approximation in ("exact", "quadratic", "gp")
)
EVERY_METHOD = (
    "random", "forward", "visible", "bins", "max-visibility",
    "max-visibility-swapped", *FISHER, "fisher-worst-trace", "fisher-stationary-trace",
    "mlp-2d", "mlp-2d+z", "mlp-2d+3d",
)  # fmt: skip

_BAD = {"random": 0.4, "forward": 0.45, "max-visibility-swapped": 0.42, "fisher-worst-trace": 0.1,
        "fisher-stationary-trace": 0.05}  # fmt: skip


def make_scores(methods=EVERY_METHOD, reference="mlp-2d+3d", top_n=(1, 5, 10), scenes=("a", "b"), seed=0):
    """A table as the evaluate stage writes it, of 50 locations a scene; the oracle's shares are 0.9."""
    rng = np.random.default_rng(seed)
    shape = (len(top_n), len(KEYS))
    rows = []
    for scene in ("all", *scenes):
        n_locations = 50 * (len(scenes) if scene == "all" else 1)
        raw = {method: np.round(50 * (_BAD.get(method, 0.7) + rng.uniform(0, 0.1, shape))) / 50 for method in methods}
        raw["oracle"] = np.full(shape, 0.9)
        unknown = np.full(shape, np.nan)
        for method, shares in raw.items():
            differences = shares - (raw[reference] if reference else unknown)
            learned = method.startswith("mlp")
            width = 0.0 if method == reference else 0.02
            for number, n in enumerate(top_n):
                row = {"method": method, "occlusion": "mesh", "candidates": "all"}
                row |= {"top_n": n, "scene": scene}
                row |= {"n_locations": n_locations, "n_views": n * n_locations}
                for key, share, difference in zip(KEYS, shares[number], differences[number], strict=True):
                    row |= {f"good_{key}": share * n * n_locations, f"raw_{key}": share}
                    row |= {f"raw_low_{key}": share - 0.02, f"raw_high_{key}": share + 0.02}
                    row |= {f"normalized_{key}": share / 0.9, f"normalized_low_{key}": share / 0.9 - 0.02}
                    row |= {f"normalized_high_{key}": min(1.0, share / 0.9 + 0.02)}
                    some = min(1.0, share + 0.01 * n)
                    row |= {f"any_{key}": some, f"any_low_{key}": some - 0.03, f"any_high_{key}": min(1.0, some + 0.03)}
                    row |= {f"released_{key}": share / RELEASED_DIVISOR}
                    row |= {f"regret_{key}": 0.9 - share, f"regret_low_{key}": 0.88 - share}
                    row |= {f"regret_high_{key}": 0.92 - share, f"difference_{key}": difference}
                    row |= {f"difference_low_{key}": difference - width, f"difference_high_{key}": difference + width}
                    row |= {f"p_{key}": 0.04 if width else 1.0}
                row |= {"reference": reference}
                row |= {"average_precision": rng.random(), "roc_auc": rng.random()}
                row |= {"ece": 0.0712 if learned else np.nan, "ece_scaled": 0.0234 if learned else np.nan}
                rows.append({**row, "temperature": 1.375 if learned else np.nan})
    return pd.DataFrame(rows)
