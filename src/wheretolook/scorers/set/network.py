"""The network over the set of landmarks that a view sees: whether the view localizes."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor, nn
from torch.nn.functional import batch_norm, binary_cross_entropy_with_logits, logsigmoid

from wheretolook.geometry.pose_information import PLACES, PRIOR, SIGNS
from wheretolook.inputs.landmark_features import ATTRIBUTES, ViewLandmarks
from wheretolook.scorers.matchability.network import (
    N_EXPECTED,
    LandmarkNetwork,
    MatchabilityNetwork,
    StandardAttributes,
    expected_parts,
)
from wheretolook.scorers.set.config import SetConfig
from wheretolook.training.attribute_statistics import AttributeStatistics
from wheretolook.utils.errors import WeightsError


def information_matrices(numbers: Tensor) -> Tensor:
    """`wheretolook.geometry.pose_information.information_matrices` of sums (..., 15), shift first, turn second."""
    places, signs = _layout(numbers.device)
    return numbers[..., places] * signs


@cache
def _layout(device: torch.device) -> tuple[Tensor, Tensor]:
    with torch.inference_mode(False):  # what is made in that mode cannot be trained with later
        return torch.from_numpy(PLACES).to(device), torch.from_numpy(SIGNS).to(device)


EXPECTED = (
    "log_expected_inliers",  # log(1 + landmarks expected to be found)
    "log_visible",  # log(1 + landmarks in view)
    "expected_share",  # how many of these are expected to be found
    "log_position_variance",  # of the expected covariance: the trace of its block of the position
    "log_orientation_variance",
    "log_det_information",
    *(f"log_variance_{axis}" for axis in "xyz"),  # of the position, along the camera's axes
    "log_spread",  # area of the image the landmarks expected to be found spread over: det of their second moment
)
"""Outputs of `expected_statistics`."""

ALL_STATISTICS = (*EXPECTED, "axis_height", "log_expected_cells")
"""All statistics of a view; the last is log(1 + cells of the sphere expected to hold a detected landmark)."""

DEFAULT_STATISTICS = (
    "log_expected_inliers",
    "log_visible",
    "log_position_variance",
    "log_orientation_variance",
    "log_expected_cells",
)
"""Inputs of the head by default: chosen by cross-validation over the scenes of configs/cameras.yaml."""

CELLS = 30
"""Cells that 180 degrees are cut into, across and down: 6 degrees each, the same for every camera."""


class SetNetwork(LandmarkNetwork):
    """Scores a view by the set of landmarks it sees, without bins.

    Each landmark has a probability of being found. Weighted by it, the landmarks' Fisher information sums up to the
    information that the view can be expected to have on its pose, and its inverse to the expected covariance: how far
    off position and orientation will be, which is what a label asks. So the probability is the attention by which
    landmarks are pooled; on request further attention pools what else there may be to know of them, in `pooled`
    numbers. It also tells over how many cells of the view the landmarks spread that will be found. All of these are
    made of sums over landmarks, so in training a random sample of them, scaled up, will do.

    `width` and `head` are units of the layers that look at single landmarks and of those that decide; `hidden` names
    attributes not to look at. Of "across", "down" and "distance" the information remains. `told` names the
    statistics of a view, of `ALL_STATISTICS`, that the deciding layers are given. Given more, they learn
    their training scenes by heart and choose worse elsewhere than the expected inliers alone.
    """

    def __init__(
        self,
        statistics: AttributeStatistics,
        width: int = 48,
        pooled: int = 0,
        head: int = 48,
        dropout: float = 0.1,
        hidden: tuple[str, ...] = (),
        told: tuple[str, ...] = DEFAULT_STATISTICS,
    ) -> None:
        options = {"width": width, "pooled": pooled, "head": head, "dropout": dropout}
        super().__init__(statistics, **options, hidden=hidden, told=told)
        self.pose_variances = pose_variances  # replaced where there is no Cholesky decomposition
        self._told = [ALL_STATISTICS.index(name) for name in told]
        self._cells = "log_expected_cells" in told
        self.matchability = MatchabilityNetwork(statistics, width, hidden)
        self.attention = None
        if pooled:
            layers = nn.Linear(len(self.attributes), width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
            self.attention = nn.Sequential(
                StandardAttributes(statistics, hidden), *layers, nn.Linear(width, 1 + pooled)
            )
        self.standard = nn.BatchNorm1d(len(told) + pooled)
        n_features = self.standard.num_features
        self.linear = nn.Linear(n_features, 1)
        first = nn.Linear(n_features, head), nn.ReLU(), nn.Dropout(dropout)
        self.decide = nn.Sequential(*first, nn.Linear(head, head), nn.ReLU(), nn.Linear(head, 1))

    def forward(
        self, values: Tensor, taken: Tensor, n_visible: Tensor, axis_height: Tensor, found: Tensor | None = None
    ) -> Tensor:
        """Logits (B,) from samples (B, K, A) of each view's landmarks, of which the first `taken` (B,) are its own.

        A view sees `n_visible` (B,) landmarks in all; `axis_height` (B,) is the z of its optical axis in the world.
        """
        return self._seen(values, self.matchability(values), taken, n_visible, axis_height)

    def learn_more(self, options: SetConfig, count: float, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B,) of the inputs of `forward`, and a loss beside theirs, with which the chances stay true.

        The fifth input tells which landmarks were found, (B, K), NaN where that is not known. The `count` of views
        divides the loss, and the landmarks that a step looks at of a view.
        """
        values, taken, n_visible, axis_height, found = inputs
        log_odds = self.matchability(values)
        logits = self._seen(values, log_odds, taken, n_visible, axis_height)
        known = ~found.isnan()
        missed = binary_cross_entropy_with_logits(log_odds[known], found[known], reduction="sum")
        return logits, options.landmark_loss * missed / (count * options.landmarks)

    def _seen(self, values: Tensor, log_odds: Tensor, taken: Tensor, n_visible: Tensor, axis_height: Tensor) -> Tensor:
        there = torch.arange(values.shape[1], device=values.device) < taken[:, None]
        sums = (self.parts(values, log_odds) * there[..., None]).sum(1)
        each = n_visible / taken.clamp(min=1)
        cells = None
        if self._cells:
            views = torch.arange(len(values), device=values.device)[:, None].expand_as(log_odds)[there]
            cells = expected_cells(values[there], log_odds[there], views, each, self.attributes)
        return self.logits(sums * each[:, None], n_visible, axis_height, cells)

    def score(self, landmarks: ViewLandmarks, n_visible: Tensor, axis_height: Tensor) -> Tensor:
        """Logits (B,) from described landmarks, which may be a part of those that each view sees; see `forward`."""
        values = landmarks.values
        log_odds = self.matchability(landmarks.values)
        # summed in double precision: in single, the sums of two machines may differ by more than scores should
        parts = self.parts(values, log_odds).double()
        sums = torch.segment_reduce(parts, "sum", lengths=landmarks.counts, initial=0.0)
        each = n_visible / landmarks.counts.clamp(min=1)
        cells = expected_cells(values, log_odds, landmarks.views, each, self.attributes) if self._cells else None
        return self.logits(sums * each[:, None], n_visible, axis_height, cells)

    def parts(self, values: Tensor, log_odds: Tensor) -> Tensor:
        """What each landmark (..., A) adds to its view's sums, (..., D), by its log-odds of being found (...,)."""
        expected = expected_parts(values, log_odds, self.attributes)
        if self.attention is None:
            return expected
        attended = self.attention(values)
        weight = attended[..., :1].clamp(-8, 8).exp()
        return torch.cat([expected, weight, weight * attended[..., 1:]], -1)

    def logits(self, sums: Tensor, n_visible: Tensor, axis_height: Tensor, cells: Tensor | None = None) -> Tensor:
        """Logits (B,) from the sums over each view's landmarks (B, D), and `expected_cells` (B,) if told of them."""
        statistics = expected_statistics(sums[:, :N_EXPECTED], n_visible, self.pose_variances)
        known = [statistics, axis_height[:, None]]
        if cells is not None:
            known.append(cells.log1p()[:, None])
        features = [torch.cat(known, 1)[:, self._told]]
        if self.attention is not None:
            features.append(sums[:, N_EXPECTED + 1 :] / (sums[:, N_EXPECTED : N_EXPECTED + 1] + 1e-6))
        joined = torch.cat(features, 1).float()
        if self.training and len(joined) < 2:  # one view has no spread of its own; a process's share may be empty
            standard = self.standard
            joined = batch_norm(joined, standard.running_mean, standard.running_var, standard.weight, standard.bias)
        else:
            joined = self.standard(joined)
        return (self.linear(joined) + self.decide(joined)).squeeze(-1)


def expected_cells(
    values: Tensor, log_odds: Tensor, views: Tensor, each: Tensor, attributes: tuple[str, ...] = ATTRIBUTES
) -> Tensor:
    """Cells of 6 degrees in which a landmark can be expected to be found, (B,), of B views.

    A view that finds a hundred landmarks in one corner knows its pose worse than one that finds them all over the
    image. Landmarks have `values` (E, A) and `log_odds` of being found (E,), and are of the `views` (E,); each of them
    stands for `each` (B,) landmarks in its view.
    """
    # in double precision, so that a landmark near the border of a cell lies in the same one on every machine
    across, down = (values[:, attributes.index(name)].double().atan() for name in ("across", "down"))
    column, row = (((angle / torch.pi + 0.5) * CELLS).long().clamp(0, CELLS - 1) for angle in (across, down))
    place = (views * CELLS + row) * CELLS + column
    # a sum of the logarithms of the chances that none is found
    none = torch.zeros(len(each) * CELLS**2, dtype=log_odds.dtype, device=log_odds.device)
    none = none.index_add(0, place, logsigmoid(-log_odds)).view(len(each), CELLS**2)
    return -torch.expm1(none * each[:, None]).sum(1)


def pose_variances(information: Tensor) -> tuple[Tensor, Tensor]:
    """Return the diagonals of inverses (B, 6) and the log determinants (B,) of information matrices (B, 6, 6)."""
    try:
        factor = torch.linalg.cholesky(information)
    except torch.linalg.LinAlgError as error:  # NaN, by weights that are too large
        problem = "these weights give no numbers: they are damaged, or the map is"
        raise WeightsError(problem, fix="Give other weights, or train again.") from error
    unit = torch.eye(6, dtype=factor.dtype, device=factor.device).expand_as(factor)
    # not by `cholesky_inverse`, which takes the matrices of a batch one by one on a GPU
    variances = torch.linalg.solve_triangular(factor, unit, upper=False).square().sum(-2)
    return variances, 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def expected_statistics(
    sums: Tensor, n_visible: Tensor, variances_of: Callable[[Tensor], tuple[Tensor, Tensor]] = pose_variances
) -> Tensor:
    """`EXPECTED`, (B, len(EXPECTED)), of views by sums of `expected_parts` (B, N_EXPECTED), and landmarks seen (B,).

    `variances_of` computes what `pose_variances` does.
    """
    inliers = sums[:, 0]
    moments = sums[:, 16:] / (sums[:, :1] + 1e-6)
    # in double precision: the covariance is an inverse
    information = information_matrices(sums[:, 1:16].double()) + PRIOR * torch.eye(6, device=sums.device).double()
    variances, log_det = variances_of(information)
    across = moments[:, 0]
    down = moments[:, 1]
    spread = (moments[:, 2] - across**2) * (moments[:, 4] - down**2) - (moments[:, 3] - across * down) ** 2
    counts = torch.stack([inliers.log1p(), n_visible.float().log1p(), inliers / n_visible.clamp(min=1)], 1)
    position = variances[:, :3].sum(1).log()
    orientation = variances[:, 3:].sum(1).log()
    of_pose = torch.stack([position, orientation, log_det], 1).float()
    return torch.cat([counts, of_pose, variances[:, :3].log().float(), (spread.clamp(min=0) + 1e-4).log()[:, None]], 1)
