"""Networks over landmarks: whether the localizer detects each, and whether a view of them localizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
        if missing := {"across", "down", "distance", "pixel_angle", "pixel_size_ratio"} - {*names}:
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
        nn.init.constant_(last.bias, -2.0)  # log-odds of detection, about one in eight, as in real views
        self.layers = nn.Sequential(
            nn.Linear(len(self.attributes), width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), last
        )

    def forward(self, values: Tensor) -> Tensor:
        """Return log-odds of detection (...) of landmarks (..., A)."""
        return self.layers(self.input(values)).squeeze(-1)


def bearing_precision(values: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """Return one over the variance of each landmark's bearing (...), from attributes (..., A).

    A keypoint is off by a pixel of the camera, and the landmark by what a pixel of the mapping images covers. The unit
    is a pixel of a focal length of 320 pixels, so information does not depend on image sizes.
    """
    pixel = values[..., attributes.index("pixel_angle")] + log(320)
    ratio = values[..., attributes.index("pixel_size_ratio")].nan_to_num(nan=0.0)
    return (-2 * pixel).exp() / (1 + (-2 * ratio).exp())


MAPPED_BY = ("mapped_angle", "track_length", "direction_spread")
"""Attributes that the covariance of a landmark follows from, with its distances."""


def mapped_precision(values: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """Return one over the variance of each landmark's bearing (...), as its track determines its position.

    n rays that meet in a landmark at the mean distance d, with keypoint noise s / f, give it the covariance
    (s d / f)^2 / n across their mean direction, and 1 / (2 e) times that along it, where e = 1 - |mean of the unit
    directions|, to the first order in e. A camera that sees it at the angle a to that direction, at the distance D, thus
    has the variance s^2 / f^2 + (s d / f)^2 / (n D^2) (1 + (1 / (2 e) - 1) sin^2 a / 2) on average over the two axes of
    the image. In the unit of `bearing_precision`, for a noise of one pixel. That function counts landmarks as observed
    once, from anywhere.
    """
    if not set(MAPPED_BY) <= set(attributes):
        return bearing_precision(values, attributes)
    cosine, log_n, spread = (values[..., attributes.index(name)] for name in MAPPED_BY)
    pixel, ratio = (values[..., attributes.index(name)] for name in ("pixel_angle", "pixel_size_ratio"))
    return precision_of_track(pixel, ratio, cosine, (-log_n).exp(), along(spread))


def along(spread: Tensor) -> Tensor:
    """Return the excess variance of landmarks along their mean direction over that across it, which is one."""
    return 0.5 / spread.clamp(min=1e-6) - 1  # rays in one direction: 1,000 times the deviation, and finite


def precision_of_track(pixel: Tensor, ratio: Tensor, cosine: Tensor, of_track: Tensor, excess: Tensor) -> Tensor:
    """Return `mapped_precision` from logs of a pixel's angle and size ratio, cosine, 1 / n and `along`."""
    landmark = (-2 * ratio.nan_to_num(nan=0.0)).exp() * of_track * (1 + excess * (1 - cosine**2) / 2)
    return (-2 * (pixel + log(320))).exp() / (1 + landmark)


def bearing_numbers(values: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """Return `geometry.pose_information.bearing_numbers` (..., 15) of landmarks (..., A), along the camera's axes."""
    across, down, log_distance = (values[..., attributes.index(name)] for name in ("across", "down", "distance"))
    bearing = torch.stack([across, down, torch.ones_like(across)], -1)
    bearing = bearing / bearing.norm(dim=-1, keepdim=True)
    inverse = (-log_distance).exp()[..., None]
    x, y, z = bearing.unbind(-1)
    plane = torch.stack([1 - x * x, -x * y, -x * z, 1 - y * y, -y * z, 1 - z * z], -1)
    return torch.cat([plane * inverse**2, bearing * inverse, plane], -1)


N_EXPECTED = 18  # detection, information and `mapped_precision` of a landmark, see `expected_parts`


def expected_parts(values: Tensor, log_odds: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """Return what landmarks (..., A) with log-odds of detection (...) add to a view's sums, (..., N_EXPECTED)."""
    p_detect = log_odds.sigmoid()[..., None]
    weight = p_detect * bearing_precision(values, attributes)[..., None]
    mapped = p_detect * mapped_precision(values, attributes)[..., None]
    squared = (2 * values[..., attributes.index("distance"), None]).exp()
    return torch.cat([p_detect, weight * bearing_numbers(values, attributes), mapped / squared, mapped], -1)


def information_matrices(numbers: Tensor) -> Tensor:
    """Return `geometry.pose_information.information_matrices` (..., 6, 6) of sums (..., 15)."""
    places, signs = _layout(numbers.device)
    return numbers[..., places] * signs


@cache
def _layout(device: torch.device) -> tuple[Tensor, Tensor]:
    with torch.inference_mode(False):  # what is made in that mode cannot be trained with later
        return torch.from_numpy(PLACES).to(device), torch.from_numpy(SIGNS).to(device)


VIEW_STATISTICS = (
    "log_expected_inliers",  # log(1 + landmarks expected to be detected)
    "log_visible",  # log(1 + visible landmarks)
    "log_position_variance",  # of the expected covariance: the trace of its block of the position
    "log_orientation_variance",
    "log_expected_cells",  # log(1 + cells of the sphere expected to hold a detected landmark)
)
"""Statistics of a view, the inputs of the head: chosen by cross-validation over the scenes of configs/cameras.yaml. With
more it overfits its training scenes (docs/research/learners.md). None depends on the camera's axes."""

MAPPED_DEVIATIONS = ("log_mapped_position_deviation", "log_mapped_orientation_deviation")
"""Logs of the expected standard deviations of a pose by `mapped_precision`, in metres and degrees, for keypoints with a
noise of one pixel, in the mapping images and in the camera's."""

CELLS = 30
"""Cells that 180 degrees are cut into, across and down: 6 degrees each, the same for every camera."""


@dataclass(frozen=True, eq=False)
class ViewSums:
    """Sums over the landmarks of B views, from which their statistics follow."""

    sums: Tensor  # (B, N_EXPECTED) of `expected_parts`
    n_visible: Tensor  # (B,) visible landmarks
    cells: Tensor  # (B,) `expected_cells`


class SetNetwork(LandmarkNetwork):
    """Scores a view from the set of its visible landmarks, without bins.

    Each landmark's probability of detection weights its Fisher information. The sum is the expected information on the
    pose, and its inverse the expected covariance of position and orientation, which decides the label. Another
    statistic is the number of cells of the view that hold a detected landmark. All statistics follow from sums over
    landmarks, so training uses a random sample, scaled up.

    `width` and `head` are units of the layers for single landmarks and of the head; `hidden` names attributes that are
    no inputs of these layers.
    """

    def __init__(
        self,
        statistics: FeatureStatistics,
        width: int = 48,
        head: int = 48,
        dropout: float = 0.1,
        hidden: tuple[str, ...] = (),
    ) -> None:
        super().__init__(statistics, width=width, head=head, dropout=dropout, hidden=hidden)
        self.pose_variances = pose_variances  # replaced where there is no Cholesky decomposition
        self.matchability = MatchabilityNetwork(statistics, width, hidden)
        n_inputs = len(VIEW_STATISTICS)
        self.standard = nn.BatchNorm1d(n_inputs)
        self.linear = nn.Linear(n_inputs, 1)
        self.decide = nn.Sequential(
            nn.Linear(n_inputs, head),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(head, head),
            nn.ReLU(),
            nn.Linear(head, 1),
        )

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """See `LandmarkNetwork.of_description`. Weights of versions up to 0.3.0 name their statistics, as "told"."""
        options = dict(stored["options"])
        if options.pop("pooled", 0) or tuple(options.pop("told", VIEW_STATISTICS)) != VIEW_STATISTICS:
            raise ValueError("the head has inputs that are no longer computed: train it again")
        return super().of_description({**stored, "options": options})

    def forward(self, values: Tensor, n_sampled: Tensor, n_visible: Tensor, detected: Tensor | None = None) -> Tensor:
        """Return logits (B,) from samples (B, K, A) of each view's landmarks, of which the first `n_sampled` (B,) count.

        `n_visible` (B,) landmarks are visible in all.
        """
        return self._logits_of_samples(values, self.matchability(values), n_sampled, n_visible)

    def learn_more(
        self, options: SetConfig, count: float, values: Tensor, n_sampled: Tensor, n_visible: Tensor, detected: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return logits (B,) of the inputs of `forward`, and a further loss of the detection probabilities.

        `detected` (B, K) is 1 for detected landmarks, 0 for others, NaN if unknown. The loss is divided by the `count`
        of views and the landmarks of a training step's window.
        """
        log_odds = self.matchability(values)
        logits = self._logits_of_samples(values, log_odds, n_sampled, n_visible)
        known = ~detected.isnan()
        missed = binary_cross_entropy_with_logits(log_odds[known], detected[known], reduction="sum")
        return logits, options.landmark_loss * missed / (count * options.landmarks)

    def _logits_of_samples(self, values: Tensor, log_odds: Tensor, n_sampled: Tensor, n_visible: Tensor) -> Tensor:
        valid = torch.arange(values.shape[1], device=values.device) < n_sampled[:, None]
        sums = (expected_parts(values, log_odds, self.attributes) * valid[..., None]).sum(1)
        each = n_visible / n_sampled.clamp(min=1)
        views = torch.arange(len(values), device=values.device)[:, None].expand_as(log_odds)[valid]
        cells = expected_cells(values[valid], log_odds[valid], views, each, self.attributes)
        return self.logits(ViewSums(sums * each[:, None], n_visible, cells))

    def sums_of(self, landmarks: ViewLandmarks, n_visible: Tensor) -> ViewSums:
        """Return the sums of described landmarks, possibly a sample of the `n_visible` (B,), without gradients."""
        values = landmarks.values
        with torch.inference_mode():
            log_odds = self.matchability(values)
            # summed in double precision: in single, the sums of two machines may differ by more than scores should
            parts = expected_parts(values, log_odds, self.attributes).double()
            sums = torch.segment_reduce(parts, "sum", lengths=landmarks.counts, initial=0.0)
            each = n_visible / landmarks.counts.clamp(min=1)
            cells = expected_cells(values, log_odds, landmarks.views, each, self.attributes)
            return ViewSums(sums * each[:, None], n_visible, cells)

    def logits(self, views: ViewSums) -> Tensor:
        """Return logits (B,) of views."""
        inputs = self.statistics_of(views).float()
        if self.training and len(inputs) < 2:  # one view has no spread of its own; a process's share may be empty
            standard = self.standard
            inputs = batch_norm(inputs, standard.running_mean, standard.running_var, standard.weight, standard.bias)
        else:
            inputs = self.standard(inputs)
        return (self.linear(inputs) + self.decide(inputs)).squeeze(-1)

    def statistics_of(self, views: ViewSums) -> Tensor:
        """Return `VIEW_STATISTICS` (B, S) of views."""
        # in double precision: the covariance is an inverse
        information = information_matrices(views.sums[:, 1:16].double())
        information = information + PRIOR * torch.eye(6, device=information.device).double()
        variances = self.pose_variances(information)
        counts = torch.stack([views.sums[:, 0].log1p(), views.n_visible.float().log1p()], 1)
        of_pose = torch.stack([variances[:, :3].sum(1).log(), variances[:, 3:].sum(1).log()], 1).float()
        return torch.cat([counts, of_pose, views.cells.log1p()[:, None]], 1)


def mapped_deviations(views: ViewSums, statistics: Tensor) -> Tensor:
    """Return `MAPPED_DEVIATIONS` (B, 2) of views with `VIEW_STATISTICS` (B, S).

    The covariance by `bearing_precision` is scaled by the ratio of both precisions, summed over the landmarks: for the
    position over their squared distances. That is within 6 % of the exact deviation on maps of photographs.
    """
    sums = views.sums.double()
    # of each landmark, the traces of its blocks are twice its precision, once over the squared distance
    ratios = torch.stack(
        [sums[:, [1, 4, 6]].sum(1) / (2 * sums[:, 16]), sums[:, [10, 13, 15]].sum(1) / (2 * sums[:, 17])], 1
    )
    columns = [VIEW_STATISTICS.index(name) for name in ("log_position_variance", "log_orientation_variance")]
    unit = torch.tensor([-log(320), log(180 / torch.pi) - log(320)], device=sums.device).double()
    # without any landmark, the prior alone is left
    return (statistics[:, columns].double() + ratios.nan_to_num(nan=1.0).log()) / 2 + unit


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


def pose_variances(information: Tensor) -> Tensor:
    """Return the diagonals of the inverses of information matrices (B, 6, 6), (B, 6)."""
    try:
        factor = torch.linalg.cholesky(information)
    except torch.linalg.LinAlgError as error:  # NaN, by weights that are too large
        raise WeightsError("scores are not finite", fix="Give other weights, or check the map.") from error
    unit = torch.eye(6, dtype=factor.dtype, device=factor.device).expand_as(factor)
    # not by `cholesky_inverse`, which takes the matrices of a batch one by one on a GPU
    return torch.linalg.solve_triangular(factor, unit, upper=False).square().sum(-2)
