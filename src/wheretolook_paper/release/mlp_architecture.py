"""Layers of the paper's network, read from the module, and its activations."""

from __future__ import annotations

import pandas as pd
import torch
from torch import Tensor, nn

from wheretolook.geometry.poses import Float
from wheretolook.inputs.bins import BinnedViews
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
