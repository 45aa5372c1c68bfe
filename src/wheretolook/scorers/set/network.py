"""Networks over landmarks: whether the localizer detects each, and whether a view of them localizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from math import log
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn.functional import batch_norm, binary_cross_entropy_with_logits, logsigmoid

from wheretolook.geometry.pose_information import PLACES, PRIOR, SIGNS
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.landmark_features import ViewLandmarks
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.scorers.set import SetConfig
from wheretolook.training.trained_network import StoredNetwork
from wheretolook.utils.errors import WeightsError

INITIAL_LOG_ODDS = -2.0  # of detection, by an untrained network: about one in eight, as in real views
REQUIRED = ("across", "down", "distance", "pixel_angle", "pixel_size_ratio")  # attributes that locate a landmark


class LandmarkNetwork(StoredNetwork):
    """A network over single landmarks, whose inputs are the attributes named by its statistics, in that order.

    It is rebuilt from its statistics and options.
    """

    def __init__(self, statistics: FeatureStatistics, **options: Any) -> None:
        super().__init__()
        self.statistics = statistics
        self.attributes = statistics.names
        self.options = options

    def description(self) -> dict[str, Any]:
        """Return the attributes, their statistics, and the options."""
        stored = {"attributes": list(self.attributes), "statistics": self.statistics.record()}
        return stored | {"options": self.options}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """Build the untrained network of a description.

        Raises a ValueError if it names an attribute that this version's maps lack, or none that locates a landmark.
        """
        names = tuple(stored["attributes"])
        if missing := {*REQUIRED} - {*names}:
            raise ValueError(f"the attribute {min(missing)}, which locates a landmark, is missing")
        options = {name: tuple(x) if isinstance(x, list) else x for name, x in stored["options"].items()}
        return cls(FeatureStatistics.of_record(names, stored["statistics"], ATTRIBUTES), **options)


class StandardAttributes(nn.Module):
    """Standardizes attributes of landmarks; unknown and hidden values become 0, the mean."""

    mean: Tensor
    scale: Tensor

    def __init__(self, statistics: FeatureStatistics, hidden: tuple[str, ...] = ()) -> None:
        super().__init__()
        known = zip(statistics.names, statistics.std, strict=True)
        scale = [0.0 if name in hidden else 1 / std for name, std in known]
        # not persistent: the header of weights stores them
        self.register_buffer("mean", torch.tensor(statistics.mean), persistent=False)
        self.register_buffer("scale", torch.tensor(scale), persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        """Return standardized values (..., A) of landmarks' attributes (..., A)."""
        return ((values - self.mean) * self.scale).nan_to_num(nan=0.0)


class MatchabilityNetwork(LandmarkNetwork):
    """Predicts whether a visible landmark is matched as an inlier, with two layers of `width` units."""

    def __init__(self, statistics: FeatureStatistics, width: int = 48, hidden: tuple[str, ...] = ()) -> None:
        super().__init__(statistics, width=width, hidden=hidden)
        self.input = StandardAttributes(statistics, hidden)
        last = nn.Linear(width, 1)
        nn.init.constant_(last.bias, INITIAL_LOG_ODDS)
        self.layers = nn.Sequential(
            nn.Linear(len(self.attributes), width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), last
        )

    def forward(self, values: Tensor) -> Tensor:
        """Return log-odds of detection (...) of landmarks (..., A)."""
        return self.layers(self.input(values)).squeeze(-1)


REFERENCE_FOCAL_PX = 320.0
"""A pixel of this focal length is the unit of a bearing's noise, so information does not depend on image sizes."""


def bearing_precision(values: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """Return one over the variance of each landmark's bearing (...), from attributes (..., A).

    A keypoint is off by a pixel of the camera, and the landmark by what a pixel of the mapping images covers.
    """
    pixel = values[..., attributes.index("pixel_angle")] + log(REFERENCE_FOCAL_PX)
    ratio = values[..., attributes.index("pixel_size_ratio")].nan_to_num(nan=0.0)
    return (-2 * pixel).exp() / (1 + (-2 * ratio).exp())


def bearing_numbers(values: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """Return `geometry.pose_information.bearing_numbers` (..., 15) of landmarks (..., A), along the camera's axes."""
    across, down, log_distance = (values[..., attributes.index(name)] for name in ("across", "down", "distance"))
    bearing = torch.stack([across, down, torch.ones_like(across)], -1)
    bearing = bearing / bearing.norm(dim=-1, keepdim=True)
    inverse = (-log_distance).exp()[..., None]
    x, y, z = bearing.unbind(-1)
    plane = torch.stack([1 - x * x, -x * y, -x * z, 1 - y * y, -y * z, 1 - z * z], -1)
    return torch.cat([plane * inverse**2, bearing * inverse, plane], -1)


N_EXPECTED = 1 + 15 + 5  # detection, information and image moments of a landmark, see `expected_parts`


def expected_parts(values: Tensor, log_odds: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """Return what landmarks (..., A) with log-odds of detection (...) add to a view's sums, (..., N_EXPECTED)."""
    p_detect = log_odds.sigmoid()[..., None]
    weight = p_detect * bearing_precision(values, attributes)[..., None]
    across, down = (values[..., attributes.index(name), None] for name in ("across", "down"))
    moments = torch.cat([across, down, across * across, across * down, down * down], -1)
    return torch.cat([p_detect, weight * bearing_numbers(values, attributes), p_detect * moments], -1)


def information_matrices(numbers: Tensor) -> Tensor:
    """Return `geometry.pose_information.information_matrices` (..., 6, 6) of sums (..., 15)."""
    places, signs = _layout(numbers.device)
    return numbers[..., places] * signs


@cache
def _layout(device: torch.device) -> tuple[Tensor, Tensor]:
    with torch.inference_mode(False):  # what is made in that mode cannot be trained with later
        return torch.from_numpy(PLACES).to(device), torch.from_numpy(SIGNS).to(device)


EXPECTED = (
    "log_expected_inliers",  # log(1 + landmarks expected to be detected)
    "log_visible",  # log(1 + visible landmarks)
    "expected_share",  # share of these
    "log_position_variance",  # of the expected covariance: the trace of its block of the position
    "log_orientation_variance",
    "log_det_information",
    *(f"log_variance_{axis}" for axis in "xyz"),  # of the position, along the camera's axes
    "log_spread",  # spread of detected landmarks over the image: det of their second moment
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
    """Scores a view from the set of its visible landmarks, without bins.

    Each landmark's probability of detection weights its Fisher information. The sum is the expected information on the
    pose, and its inverse the expected covariance of position and orientation, which decides the label. On request,
    attention pools `pooled` further features. Another statistic is the number of cells of the view that hold a detected
    landmark. All statistics follow from sums over landmarks, so training uses a random sample, scaled up.

    `width` and `head` are units of the layers for single landmarks and of the head; `hidden` names attributes that are
    no inputs of these layers. `view_statistics` names the inputs of the head, of `ALL_STATISTICS`: with more than the
    default ones it overfits its training scenes. In weights files they are called "told".
    """

    def __init__(
        self,
        statistics: FeatureStatistics,
        width: int = 48,
        pooled: int = 0,
        head: int = 48,
        dropout: float = 0.1,
        hidden: tuple[str, ...] = (),
        view_statistics: tuple[str, ...] = DEFAULT_STATISTICS,
    ) -> None:
        options = {"width": width, "pooled": pooled, "head": head, "dropout": dropout, "hidden": hidden}
        super().__init__(statistics, **options, told=view_statistics)
        self.view_statistics = view_statistics
        self.pose_variances = pose_variances  # replaced where there is no Cholesky decomposition
        self._inputs = [ALL_STATISTICS.index(name) for name in view_statistics]
        self.needs_cells = "log_expected_cells" in view_statistics
        self.matchability = MatchabilityNetwork(statistics, width, hidden)
        self.attention = None
        if pooled:
            layers = nn.Linear(len(self.attributes), width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
            self.attention = nn.Sequential(
                StandardAttributes(statistics, hidden), *layers, nn.Linear(width, 1 + pooled)
            )
        n_features = len(view_statistics) + pooled
        self.standard = nn.BatchNorm1d(n_features)
        self.linear = nn.Linear(n_features, 1)
        first = nn.Linear(n_features, head), nn.ReLU(), nn.Dropout(dropout)
        self.decide = nn.Sequential(*first, nn.Linear(head, head), nn.ReLU(), nn.Linear(head, 1))

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """See `LandmarkNetwork.of_description`."""
        options = dict(stored["options"])
        options["view_statistics"] = options.pop("told")
        return super().of_description({**stored, "options": options})

    def forward(
        self, values: Tensor, n_sampled: Tensor, n_visible: Tensor, axis_height: Tensor, detected: Tensor | None = None
    ) -> Tensor:
        """Return logits (B,) from samples (B, K, A) of each view's landmarks, of which the first `n_sampled` (B,) count.

        `n_visible` (B,) landmarks are visible in all; `axis_height` (B,) is the z of the optical axis in the world.
        """
        return self._logits_of_samples(values, self.matchability(values), n_sampled, n_visible, axis_height)

    def learn_more(self, options: SetConfig, count: float, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits (B,) of the inputs of `forward`, and a further loss of the detection probabilities.

        The fifth input (B, K) is 1 for detected landmarks, 0 for others, NaN if unknown. The loss is divided by the
        `count` of views and the landmarks of a training step's window.
        """
        values, n_sampled, n_visible, axis_height, detected = inputs
        log_odds = self.matchability(values)
        logits = self._logits_of_samples(values, log_odds, n_sampled, n_visible, axis_height)
        known = ~detected.isnan()
        missed = binary_cross_entropy_with_logits(log_odds[known], detected[known], reduction="sum")
        return logits, options.landmark_loss * missed / (count * options.landmarks)

    def _logits_of_samples(
        self, values: Tensor, log_odds: Tensor, n_sampled: Tensor, n_visible: Tensor, axis_height: Tensor
    ) -> Tensor:
        valid = torch.arange(values.shape[1], device=values.device) < n_sampled[:, None]
        sums = (self.parts(values, log_odds) * valid[..., None]).sum(1)
        each = n_visible / n_sampled.clamp(min=1)
        cells = None
        if self.needs_cells:
            views = torch.arange(len(values), device=values.device)[:, None].expand_as(log_odds)[valid]
            cells = expected_cells(values[valid], log_odds[valid], views, each, self.attributes)
        return self.logits(sums * each[:, None], n_visible, axis_height, cells)

    def sums_of(self, landmarks: ViewLandmarks, n_visible: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sums (B, D) and `expected_cells` (B,) of described landmarks, possibly a sample of the visible."""
        values = landmarks.values
        log_odds = self.matchability(values)
        # summed in double precision: in single, the sums of two machines may differ by more than scores should
        parts = self.parts(values, log_odds).double()
        sums = torch.segment_reduce(parts, "sum", lengths=landmarks.counts, initial=0.0)
        each = n_visible / landmarks.counts.clamp(min=1)
        return sums * each[:, None], expected_cells(values, log_odds, landmarks.views, each, self.attributes)

    def parts(self, values: Tensor, log_odds: Tensor) -> Tensor:
        """Return what landmarks (..., A) with log-odds of detection (...) add to their view's sums, (..., D)."""
        expected = expected_parts(values, log_odds, self.attributes)
        if self.attention is None:
            return expected
        attended = self.attention(values)
        weight = attended[..., :1].clamp(-8, 8).exp()
        return torch.cat([expected, weight, weight * attended[..., 1:]], -1)

    def logits(self, sums: Tensor, n_visible: Tensor, axis_height: Tensor, cells: Tensor | None = None) -> Tensor:
        """Return logits (B,) from sums (B, D) over each view's landmarks, and `expected_cells` (B,) if they are an input."""
        features = [self.statistics_of(sums, n_visible, axis_height, cells)[:, self._inputs]]
        if self.attention is not None:
            features.append(sums[:, N_EXPECTED + 1 :] / (sums[:, N_EXPECTED : N_EXPECTED + 1] + 1e-6))
        joined = torch.cat(features, 1).float()
        if self.training and len(joined) < 2:  # one view has no spread of its own; a process's share may be empty
            standard = self.standard
            joined = batch_norm(joined, standard.running_mean, standard.running_var, standard.weight, standard.bias)
        else:
            joined = self.standard(joined)
        return (self.linear(joined) + self.decide(joined)).squeeze(-1)

    def statistics_of(
        self, sums: Tensor, n_visible: Tensor, axis_height: Tensor, cells: Tensor | None = None
    ) -> Tensor:
        """Return `ALL_STATISTICS` (B, S) from what `logits` takes, without the last if `cells` are not given."""
        known = [expected_statistics(sums[:, :N_EXPECTED], n_visible, self.pose_variances), axis_height[:, None]]
        if cells is not None:
            known.append(cells.log1p()[:, None])
        return torch.cat(known, 1)


def expected_cells(
    values: Tensor, log_odds: Tensor, views: Tensor, each: Tensor, attributes: tuple[str, ...] = ATTRIBUTES
) -> Tensor:
    """Return the expected number of cells of 6 degrees with a detected landmark, (B,), of B views.

    Landmarks have `values` (E, A), `log_odds` of detection (E,) and `views` (E,); each stands for `each` (B,) landmarks
    of its view. Landmarks spread over the image determine the pose better than as many in one corner.
    """
    # in double precision, so that a landmark near a cell's border is in the same cell on every machine
    across, down = (values[:, attributes.index(name)].double().atan() for name in ("across", "down"))
    column, row = (((angle / torch.pi + 0.5) * CELLS).long().clamp(0, CELLS - 1) for angle in (across, down))
    place = (views * CELLS + row) * CELLS + column
    # sum of log probabilities that none is detected
    none = torch.zeros(len(each) * CELLS**2, dtype=log_odds.dtype, device=log_odds.device)
    none = none.index_add(0, place, logsigmoid(-log_odds)).view(len(each), CELLS**2)
    return -torch.expm1(none * each[:, None]).sum(1)


def pose_variances(information: Tensor) -> tuple[Tensor, Tensor]:
    """Return the diagonals of inverses (B, 6) and the log determinants (B,) of information matrices (B, 6, 6)."""
    try:
        factor = torch.linalg.cholesky(information)
    except torch.linalg.LinAlgError as error:  # NaN, by weights that are too large
        raise WeightsError("scores are not finite", fix="Give other weights, or check the map.") from error
    unit = torch.eye(6, dtype=factor.dtype, device=factor.device).expand_as(factor)
    # not by `cholesky_inverse`, which takes the matrices of a batch one by one on a GPU
    variances = torch.linalg.solve_triangular(factor, unit, upper=False).square().sum(-2)
    return variances, 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def expected_statistics(
    sums: Tensor, n_visible: Tensor, variances_of: Callable[[Tensor], tuple[Tensor, Tensor]] = pose_variances
) -> Tensor:
    """Return `EXPECTED`, (B, len(EXPECTED)), from sums of `expected_parts` (B, N_EXPECTED) and visible landmarks (B,).

    `variances_of` is `pose_variances` or a replacement.
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
