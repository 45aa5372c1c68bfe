"""Network for the probability that a landmark is detected, and the information of landmarks on the pose."""

from __future__ import annotations

from collections.abc import Mapping
from math import log
from typing import Any, Self

import torch
from torch import Tensor, nn

from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.training.trained_network import StoredNetwork

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
