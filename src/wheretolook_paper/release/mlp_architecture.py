"""Layers and activations of the paper's network, and the paper's table of layers next to those of a network trained here."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from itertools import pairwise

import pandas as pd
import torch
from torch import Tensor, nn

from wheretolook.geometry.poses import Float
from wheretolook.inputs.bins import BinnedViews
from wheretolook.inputs.channels import PAPER_VARIANTS
from wheretolook.scorers.mlp.network import BinnedInput, ViewpointNetwork


def architecture_table(network: ViewpointNetwork) -> pd.DataFrame:
    """Return the layers of a network (paper, Tab. 1) from the input to the score, and their sum.

    Columns: `layer`; `in` and `out`, numbers of values; `parameters`, number of trained parameters.
    """
    spec = network.spec
    rows: list[tuple[str, int, int, int]] = []
    width = spec.input_size
    for module in [network.input, *network.layers]:
        after = module.out_features if isinstance(module, nn.Linear) else width
        rows.append((_name(module, network), width, after, sum(p.numel() for p in module.parameters())))
        width = after
    rows.append(("sigmoid", width, width, 0))
    table = pd.DataFrame(rows, columns=["layer", "in", "out", "parameters"])
    total = pd.DataFrame([("all", spec.input_size, width, int(table["parameters"].sum()))], columns=table.columns)
    return pd.concat([table, total], ignore_index=True)


def activations(network: ViewpointNetwork, view: BinnedViews) -> list[Float]:
    """Return the activations of a trained network for one view (a batch of one, with at least its channels).

    The standardized input (C, bins, bins), each hidden layer (width,) after its nonlinearity, and the probability (1,).
    """
    spec = network.eval().spec
    chosen = view.select(spec.channels)
    with torch.inference_mode():
        values = network.input(torch.from_numpy(chosen.means), torch.from_numpy(chosen.counts > 0))
        found: list[Tensor] = [values.reshape(len(spec.channels), spec.bins, spec.bins)]
        for layer in network.layers:
            values = layer(values)
            if isinstance(layer, nn.ReLU):
                found.append(values[0])
        found.append(values[0].double().sigmoid())
    return [value.cpu().numpy() for value in found]


def _name(module: nn.Module, network: ViewpointNetwork) -> str:
    spec = network.spec
    if isinstance(module, BinnedInput):
        return f"bins of {spec.bins} × {spec.bins}, channels {', '.join(spec.channels)}, standardized"
    if isinstance(module, nn.Linear):
        return "fully connected"
    if isinstance(module, nn.Dropout):
        return f"dropout, {module.p:g}"
    return type(module).__name__


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
