"""The set network as an ONNX graph, from a view's landmarks to the probability that it localizes.

Written operator by operator from the module's parameters: ONNX has no Cholesky decomposition, so a tracer cannot take
the expected covariance over. Here it comes from Gauss-Jordan elimination. The test compares with the module itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike, DTypeLike, NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from wheretolook.geometry.pose_information import N_NUMBERS, information_matrices
from wheretolook.scorers.matchability.network import REFERENCE_FOCAL_PX, StandardAttributes
from wheretolook.scorers.set.network import CELLS, PRIOR, SetNetwork
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError

OPSET = 17  # of 2022, so that onnxruntime 1.12 and later reads the file
IR_VERSION = 8
PARAMETERS = 6  # of a pose: shift and turn


class GraphBuilder:
    """Nodes and constants of a graph. Tensors go by their names; a number or an array becomes a constant."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: ArrayLike, dtype: DTypeLike = np.float32) -> str:
        """The name of a new constant."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype=dtype), name))
        return name

    def __call__(self, operator: str, *inputs: str | float, outputs: str = "", **attributes: Any) -> str:
        """The name of what an operator gives of tensors, and of numbers in single precision."""
        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        outputs = outputs or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, names, [outputs], **attributes))
        return outputs

    def columns(self, tensor: str, *places: int) -> str:
        """Columns of the last axis, kept as an axis."""
        return self("Gather", tensor, self.constant(places, np.int64), axis=-1)

    def column(self, tensor: str, place: int) -> str:
        """One column of the last axis, without that axis."""
        return self("Gather", tensor, self.constant(place, np.int64), axis=-1)

    def sum(self, tensor: str, axis: int, keep: bool = False) -> str:
        """The sum over an axis."""
        return self("ReduceSum", tensor, self.constant([axis], np.int64), keepdims=int(keep))

    def joined(self, *tensors: str) -> str:
        """Tensors one after the other along the last axis."""
        return self("Concat", *tensors, axis=-1)

    def double(self, tensor: str) -> str:
        """The tensor in double precision."""
        return self("Cast", tensor, to=TensorProto.DOUBLE)

    def single(self, tensor: str) -> str:
        """The tensor in single precision."""
        return self("Cast", tensor, to=TensorProto.FLOAT)

    def number(self, value: float) -> str:
        """A constant in double precision."""
        return self.constant(value, np.float64)

    def layers(self, module: nn.Module, tensor: str) -> str:
        """What layers, one after the other, give of (E, features) as they do when not training."""
        if isinstance(module, nn.Sequential):
            for part in module:
                tensor = self.layers(part, tensor)
            return tensor
        if isinstance(module, nn.Linear):
            weight, bias = (parameter.detach().cpu().numpy() for parameter in (module.weight, module.bias))
            return self("Gemm", tensor, self.constant(weight), self.constant(bias), transB=1)
        if isinstance(module, nn.ReLU):
            return self("Relu", tensor)
        if isinstance(module, nn.Dropout):
            return tensor
        if isinstance(module, StandardAttributes):
            mean = module.mean.cpu().numpy()
            scale = module.scale.cpu().numpy()
            standard = self("Mul", self("Sub", tensor, self.constant(mean)), self.constant(scale))
            return self("Where", self("IsNaN", standard), 0.0, standard)
        if isinstance(module, nn.BatchNorm1d):
            names = ("weight", "bias", "running_mean", "running_var")
            numbers = [self.constant(getattr(module, name).detach().cpu().numpy()) for name in names]
            return self("BatchNormalization", tensor, *numbers, epsilon=module.eps)
        raise WeightsError("this layer cannot be exported", value=type(module).__name__)


def set_graph(trained: TrainedNetwork[SetNetwork]) -> Any:
    """The `onnx.ModelProto` of a set network, calibrated.

    Inputs are `values` (B, K, A) float32, the attributes of at most K landmarks of each of B views, padded with zeros;
    `taken` (B,) int64, how many of them are the view's own; `n_visible` (B,) int64, how many it sees in all; and
    `axis_height` (B,) float32, z of its optical axis in the world. Outputs are `probability` (B,) float64 and
    `expected_inliers` (B,) float32, the landmarks that can be expected to be found.

    Raises a WeightsError if the network has a layer, or is told a statistic, that is not known here.
    """
    graph = GraphBuilder()
    network = trained.network
    features = _features(graph, network, _sums(graph, network))
    standard = graph.layers(network.standard, features)
    logits = graph("Add", graph.layers(network.linear, standard), graph.layers(network.decide, standard))
    logits = graph.double(graph("Squeeze", logits, graph.constant([1], np.int64)))
    logits = graph("Add", graph("Mul", logits, graph.number(trained.scale)), graph.number(trained.offset))
    graph("Sigmoid", logits, outputs="probability")

    def info(name: str, kind: int, *shape: str | int) -> Any:
        return helper.make_tensor_value_info(name, kind, shape)

    inputs = [
        info("values", TensorProto.FLOAT, "B", "K", len(network.attributes)),
        info("taken", TensorProto.INT64, "B"),
        info("n_visible", TensorProto.INT64, "B"),
        info("axis_height", TensorProto.FLOAT, "B"),
    ]
    outputs = [info("probability", TensorProto.DOUBLE, "B"), info("expected_inliers", TensorProto.FLOAT, "B")]
    content = helper.make_graph(graph.nodes, "wheretolook_set", inputs, outputs, graph.constants)
    model = helper.make_model(content, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="wheretolook")
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model, full_check=True)
    return model


@dataclass(frozen=True)
class _Sums:
    """What is summed over a view's landmarks, scaled up to all that it sees."""

    weighted: str  # (B, 4, 6) float64: `_PRODUCTS` weighted by what `_weights` gives
    pooled: str = ""  # (B, 1 + pooled): the attention, and what it pools; "" for none
    cells: str = ""  # (B,) float64: `expected_cells`; "" if the network is not told of them


_PRODUCTS = ("xx", "xy", "xz", "yy", "yz", "zz")
"""Products of the coordinates of a landmark's ray (x, y, 1) = (across, down, 1), all that the sums are made of."""

_ACROSS = np.array([
    [0, 0, 0, 1, 0, 1],  # xx: yy + zz
    [0, -1, 0, 0, 0, 0],
    [0, 0, -1, 0, 0, 0],
    [1, 0, 0, 0, 0, 1],  # yy: xx + zz
    [0, 0, 0, 0, -1, 0],
    [1, 0, 0, 1, 0, 0],  # zz: xx + yy
])  # fmt: skip
"""Of the plane P = I - f f^T across a bearing f, times the squared length of its ray: numbers from `_PRODUCTS`."""


def _sums(graph: GraphBuilder, network: SetNetwork) -> _Sums:
    """The sums of `SetNetwork.parts`, taken apart: its products are shared, and weighted by a matrix product.

    In double precision: next to a wall one landmark may tell a thousand times as much as all others.
    """
    flat = graph("Reshape", "values", graph.constant([-1, len(network.attributes)], np.int64))
    rows = graph("Concat", graph("Shape", "values", end=2), graph.constant([-1], np.int64), axis=0)  # B, K, -1
    kept = graph("Squeeze", graph("Shape", "values", start=1, end=2), graph.constant([0], np.int64))
    place = graph("Range", graph.constant(0, np.int64), kept, graph.constant(1, np.int64))
    own = graph("Less", place, graph("Unsqueeze", "taken", graph.constant([1], np.int64)))  # (B, K)
    n_visible = graph.double("n_visible")
    taken = graph.double("taken")
    enlarged = graph("Div", n_visible, graph("Max", taken, graph.number(1)))
    counted = graph("Mul", graph.double(own), graph("Unsqueeze", enlarged, graph.constant([1], np.int64)))
    counted = graph("Unsqueeze", counted, graph.constant([1], np.int64))  # (B, 1, K)

    across = network.attributes.index("across")
    down = network.attributes.index("down")
    ray = graph.double(graph.columns(flat, across, down))
    x = graph.columns(ray, 0)
    y = graph.columns(ray, 1)
    squares = graph("Mul", ray, ray)
    length2 = graph("Add", graph.sum(squares, 1, keep=True), graph.number(1))
    one = graph("Expand", graph.number(1), graph("Shape", x))
    products = graph.joined(graph.columns(squares, 0), graph("Mul", x, y), x, graph.columns(squares, 1), y, one)
    chance = network.matchability
    log_odds = graph.layers(chance.layers, graph.layers(chance.input, flat))
    weights = graph("Reshape", _weights(graph, network, flat, log_odds, length2), rows)  # (B, K, 4)
    weights = graph("Mul", graph("Transpose", weights, perm=[0, 2, 1]), counted)
    weighted = graph("MatMul", weights, graph("Reshape", products, rows))
    cells = pooled = ""
    if "log_expected_cells" in network.options["told"]:
        views = graph("Shape", "values", end=2)  # B, K
        missed = graph.double(graph("Neg", graph("Softplus", graph("Reshape", log_odds, views))))
        place = graph("Reshape", _cells(graph, graph.columns(flat, across, down)), views)
        cells = _expected_cells(graph, graph("Where", own, missed, graph.number(0)), place, enlarged)
    if network.attention is not None:
        attended = graph.layers(network.attention, flat)
        weight = graph("Exp", graph("Clip", graph.columns(attended, 0), -8.0, 8.0))
        pooled = graph.columns(attended, *range(1, 1 + int(network.options["pooled"])))
        pooled = graph("Reshape", graph.double(graph.joined(weight, graph("Mul", weight, pooled))), rows)
        pooled = graph.single(graph("Squeeze", graph("MatMul", counted, pooled), graph.constant([1], np.int64)))
    return _Sums(weighted, pooled, cells)


def _cells(graph: GraphBuilder, ray: str) -> str:
    """(E,) int64: the cell of `expected_cells`, of 30 x 30 over the view, that rays (E, 2) lie in."""
    # counted by how many borders are passed, rounded up, so that no rounding of an arctangent decides
    borders = np.tan((np.arange(1, CELLS) / CELLS - 0.5) * np.pi)
    single = borders.astype(np.float32)
    single = np.where(single < borders, np.nextafter(single, np.float32(np.inf)), single)
    passed = graph("GreaterOrEqual", graph("Unsqueeze", ray, graph.constant([2], np.int64)), graph.constant(single))
    place = graph.sum(graph.single(passed), 2)  # (E, 2), column and row
    place = graph("MatMul", place, graph.constant([1, CELLS]))
    return graph("Cast", place, to=TensorProto.INT64)


def _expected_cells(graph: GraphBuilder, missed: str, place: str, enlarged: str) -> str:
    """(B,) as `expected_cells`, by the logarithms of the chances (B, K) that landmarks in cells (B, K) are missed."""
    n_views = graph("Shape", missed, end=1)
    shape = graph("Concat", n_views, graph.constant([CELLS**2], np.int64), axis=0)
    none = graph("Expand", graph.number(0), shape)
    none = graph("ScatterElements", none, place, missed, axis=1, reduction="add")
    none = graph("Exp", graph("Mul", none, graph("Unsqueeze", enlarged, graph.constant([1], np.int64))))
    return graph.sum(graph("Sub", graph.number(1), none), 1)


def _weights(graph: GraphBuilder, network: SetNetwork, values: str, log_odds: str, length2: str) -> str:
    """(E, 4) of landmarks (E, A), by their log-odds of being found (E, 1) and the squared length (E, 1) of their rays.

    The chance of being found w; and, with that times the bearing's precision for w, with the distance n and the ray's
    squared length q, what the numbers of the information have in common: w / q, w / (q n^2) and w / (sqrt(q) n).
    """
    at = network.attributes.index
    found = told = graph("Sigmoid", graph.double(log_odds))
    if "pixel_angle" in network.attributes:  # as `bearing_precision`
        pixel = graph.double(graph.columns(values, at("pixel_angle")))
        pixel = graph("Exp", graph("Mul", graph("Add", pixel, graph.number(log(REFERENCE_FOCAL_PX))), graph.number(-2)))
        ratio = graph.double(graph.columns(values, at("pixel_size_ratio")))
        ratio = graph("Where", graph("IsNaN", ratio), graph.number(0), ratio)
        blur = graph("Add", graph("Exp", graph("Mul", ratio, graph.number(-2))), graph.number(1))
        told = graph("Mul", found, graph("Div", pixel, blur))
    near = graph("Exp", graph("Neg", graph.double(graph.columns(values, at("distance")))))
    turn = graph("Div", told, length2)
    shift = graph("Mul", graph("Mul", turn, near), near)
    both = graph("Mul", graph("Mul", turn, near), graph("Sqrt", length2))
    return graph.joined(found, turn, shift, both)


def _features(graph: GraphBuilder, network: SetNetwork, sums: _Sums) -> str:
    """(B, F) of what the deciding layers are told of views."""
    n_visible = graph.single("n_visible")
    expected = graph("Gather", graph.single(sums.weighted), graph.constant(0, np.int64), axis=1)  # (B, 6)
    inliers = graph("Gather", expected, graph.constant(5, np.int64), axis=1, outputs="expected_inliers")
    known = {
        "log_expected_inliers": graph("Log", graph("Add", inliers, 1.0)),
        "log_visible": graph("Log", graph("Add", n_visible, 1.0)),
        "expected_share": graph("Div", inliers, graph("Max", n_visible, 1.0)),
        "log_spread": _log_spread(graph, expected),
        "axis_height": "axis_height",
        **_covariance(graph, sums.weighted),
    }
    if sums.cells:
        known["log_expected_cells"] = graph.single(graph("Log", graph("Add", sums.cells, graph.number(1))))
    told = []
    for name in network.options["told"]:
        if name not in known:
            raise WeightsError("the export does not know this statistic of a view", value=name)
        told.append(graph("Unsqueeze", known[name], graph.constant([1], np.int64)))
    if sums.pooled:
        weights = graph("Add", graph.columns(sums.pooled, 0), 1e-6)
        pooled = graph.columns(sums.pooled, *range(1, 1 + int(network.options["pooled"])))
        told.append(graph("Div", pooled, weights))
    return graph.joined(*told)


def _information_layout() -> NDArray[np.float64]:
    """(24, 36): what stands where in the information matrix, flat, of the weighted products (4, 6), flat."""
    # the matrix is linear in 15 numbers: that of each unit vector says where a number stands, and with what sign
    numbers = information_matrices(np.eye(N_NUMBERS)).reshape(N_NUMBERS, -1)
    layout = np.zeros((4, 6, N_NUMBERS))
    layout[2, :, :6] = layout[1, :, 9:] = _ACROSS.T
    layout[3, [2, 4, 5], [6, 7, 8]] = 1  # the ray itself: xz, yz and zz with z = 1
    return layout.reshape(24, N_NUMBERS) @ numbers


def _covariance(graph: GraphBuilder, weighted: str) -> dict[str, str]:
    """Of the expected covariance of the pose, what `expected_statistics` tells, (B,) each; in double precision."""
    flat = graph("Reshape", weighted, graph.constant([-1, 24], np.int64))
    matrix = graph("MatMul", flat, graph.constant(_information_layout(), np.float64))
    unit = np.eye(PARAMETERS)
    prior = graph("Add", matrix, graph.constant(PRIOR * unit.reshape(-1), np.float64))
    information = graph("Reshape", prior, graph.constant([-1, PARAMETERS, PARAMETERS], np.int64))
    rest = graph("Expand", graph.constant(unit, np.float64), graph("Shape", information))
    both = graph.joined(information, rest)
    log_pivots = []
    for k in range(PARAMETERS):  # Gauss-Jordan, which needs no pivoting where a matrix is positive definite
        row = graph("Gather", both, graph.constant([k], np.int64), axis=1)  # (B, 1, 12)
        pivot = graph.columns(row, k)
        log_pivots.append(graph("Log", pivot))
        row = graph("Div", row, pivot)
        others = graph("Mul", graph.columns(both, k), graph.constant(1 - unit[:, [k]], np.float64))
        reduced = graph("Sub", both, graph("Mul", others, row))
        both = graph("Where", graph.constant(unit[:, [k]] > 0, np.bool_), row, reduced)
    inverse = graph.columns(both, *range(PARAMETERS, 2 * PARAMETERS))
    variances = graph.sum(graph("Mul", inverse, graph.constant(unit, np.float64)), 2)
    log_variances = graph.single(graph("Log", variances))
    position, orientation = (graph.sum(graph.columns(variances, *axes), 1) for axes in ((0, 1, 2), (3, 4, 5)))
    log_det = graph.sum(graph("Squeeze", graph.joined(*log_pivots), graph.constant([1], np.int64)), 1)
    return {
        "log_position_variance": graph.single(graph("Log", position)),
        "log_orientation_variance": graph.single(graph("Log", orientation)),
        "log_det_information": graph.single(log_det),
        **{f"log_variance_{axis}": graph.column(log_variances, place) for place, axis in enumerate("xyz")},
    }


def _log_spread(graph: GraphBuilder, expected: str) -> str:
    """(B,) as `expected_statistics`: the area of the image that the expected landmarks (B, 6) spread over."""
    divisor = graph("Add", graph.columns(expected, _PRODUCTS.index("zz")), 1e-6)
    moments = graph("Div", expected, divisor)
    xx, xy, across, yy, down = (graph.column(moments, place) for place in range(5))
    x, y = (graph("Sub", a, graph("Mul", b, b)) for a, b in ((xx, across), (yy, down)))
    both = graph("Sub", xy, graph("Mul", across, down))
    area = graph("Sub", graph("Mul", x, y), graph("Mul", both, both))
    return graph("Log", graph("Add", graph("Max", area, 0.0), 1e-4))
