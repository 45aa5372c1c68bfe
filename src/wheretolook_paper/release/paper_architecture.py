"""The paper's table of network layers, next to the layers of a network trained here."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from itertools import pairwise

import pandas as pd

from wheretolook.inputs.channels import PAPER_VARIANTS


def paper_architecture_table(params: Mapping[str, str]) -> pd.DataFrame:
    """Return the paper's Table 1 with the layers of a network, given the MLflow parameters of its train run.

    A row for each layer: `layer` (its number in the paper's table), `paper` and `here`.
    """
    channels = PAPER_VARIANTS[params["method"].removeprefix("mlp-")]
    bins = int(params["bins"])
    widths = [len(channels) * bins**2, *map(int, ast.literal_eval(params["hidden"]))]
    here = []
    for before, after in pairwise(widths):
        here += [f"fully connected {before} × {after}", "ReLU", f"dropout {params['dropout']}"]
    here += [f"fully connected {widths[-1]} × 1", "Sigmoid"]
    paper = ["fully connected input-size × 300", "ReLU", "dropout 0.5"]
    paper += ["fully connected 300 × 300", "ReLU", "dropout 0.5", "fully connected 300 × 1", "Sigmoid"]
    layers = [str(n // 3 + 1) + (f".{n % 3}" if n % 3 else "") for n in range(max(len(here), len(paper)))]
    return pd.DataFrame({"layer": pd.Series(layers), "paper": pd.Series(paper), "here": pd.Series(here)}).fillna("")
