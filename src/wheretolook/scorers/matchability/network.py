"""Whether a landmark in view will be found, and what landmarks tell of the pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from math import log
from typing import Any, Self

import torch
from torch import Tensor, nn

from wheretolook.inputs.landmark_features import ATTRIBUTES
from wheretolook.training.attribute_statistics import AttributeStatistics, mean_and_std
from wheretolook.training.trained_network import StoredNetwork
from wheretolook.utils.errors import WeightsError

LIKELY = -2.0
"""Log-odds of being found that an untrained network gives a landmark: about one in eight, as in real views."""


class LandmarkNetwork(StoredNetwork):
    """A network over single landmarks. It takes those of their attributes that its statistics name, in that order.

    With its statistics and options it can be built anew.
    """

    def __init__(self, statistics: AttributeStatistics, **options: Any) -> None:
        super().__init__()
        self.statistics = statistics
        self.options = options

    @property
    def attributes(self) -> tuple[str, ...]:
        """Names of the A attributes that it takes."""
        return self.statistics.attributes

    def description(self) -> dict[str, Any]:
        """Attributes, their statistics, and the options."""
        stored = asdict(self.statistics)
        return {"attributes": list(stored.pop("attributes")), "statistics": stored, "options": self.options}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """The untrained network of a description.

        Raises a WeightsError if it asks for an attribute that this version's maps do not know, or lacks one that tells
        where a landmark lies.
        """
        names = tuple(stored["attributes"])
        statistics = stored["statistics"]
        for name in names:
            if name not in ATTRIBUTES:
                fix = "Use the version that wrote them, or train again."
                raise WeightsError("these weights ask for an unknown attribute of landmarks", value=name, fix=fix)
        for name in ("across", "down", "distance", *(("pixel_size_ratio",) if "pixel_angle" in names else ())):
            if name not in names:
                raise WeightsError("these weights do not ask where a landmark lies", value=name)
        options = {name: tuple(x) if isinstance(x, list) else x for name, x in stored["options"].items()}
        return cls(AttributeStatistics(*mean_and_std(statistics, names), names), **options)


class StandardAttributes(nn.Module):
    """Attributes of landmarks, standardized; what is not known or hidden becomes 0, the mean of its kind."""

    mean: Tensor
    scale: Tensor

    def __init__(self, statistics: AttributeStatistics, hidden: tuple[str, ...] = ()) -> None:
        super().__init__()
        known = zip(statistics.attributes, statistics.std, strict=True)
        scale = [0.0 if name in hidden else 1 / std for name, std in known]
        # these follow from the description that is stored beside the weights: persistent=False
        self.register_buffer("mean", torch.tensor(statistics.mean), persistent=False)
        self.register_buffer("scale", torch.tensor(scale), persistent=False)

    def forward(self, values: Tensor) -> Tensor:
        """Standardized values of landmarks' values (..., A), in the same shape."""
        return ((values - self.mean) * self.scale).nan_to_num(nan=0.0)


class MatchabilityNetwork(LandmarkNetwork):
    """Whether a landmark in view is found: matched, and an inlier of the pose. It has two layers of `width` units."""

    def __init__(self, statistics: AttributeStatistics, width: int = 48, hidden: tuple[str, ...] = ()) -> None:
        super().__init__(statistics, width=width, hidden=hidden)
        self.input = StandardAttributes(statistics, hidden)
        last = nn.Linear(width, 1)
        nn.init.constant_(last.bias, LIKELY)
        self.layers = nn.Sequential(
            nn.Linear(len(self.attributes), width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), last
        )

    def forward(self, values: Tensor) -> Tensor:
        """Log-odds (...,) of landmarks (..., A)."""
        return self.layers(self.input(values)).squeeze(-1)


REFERENCE_FOCAL_PX = 320.0
"""A pixel of this focal length is the unit of a bearing's noise, so information does not depend on image sizes."""


def bearing_precision(values: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor | None:
    """How sharply each landmark (..., A) tells where it is seen, (...): one over its bearing's variance, by the pixels.

    A keypoint is off by a pixel, and the landmark by what a pixel of the images that mapped it covers: whichever is
    larger there counts most. None where pixels are not among the attributes, as in weights of before there were any.
    """
    if "pixel_angle" not in attributes:
        return None
    pixel = values[..., attributes.index("pixel_angle")] + log(REFERENCE_FOCAL_PX)
    ratio = values[..., attributes.index("pixel_size_ratio")].nan_to_num(nan=0.0)
    return (-2 * pixel).exp() / (1 + (-2 * ratio).exp())


def bearing_numbers(values: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """`fisher.information.bearing_numbers` (..., 15) of landmarks (..., A), in the camera's axes."""
    across, down, log_distance = (values[..., attributes.index(name)] for name in ("across", "down", "distance"))
    bearing = torch.stack([across, down, torch.ones_like(across)], -1)
    bearing = bearing / bearing.norm(dim=-1, keepdim=True)
    inverse = (-log_distance).exp()[..., None]
    x, y, z = bearing.unbind(-1)
    plane = torch.stack([1 - x * x, -x * y, -x * z, 1 - y * y, -y * z, 1 - z * z], -1)
    return torch.cat([plane * inverse**2, bearing * inverse, plane], -1)


N_EXPECTED = 1 + 15 + 5  # numbers that `expected_parts` gives of a landmark


def expected_parts(values: Tensor, log_odds: Tensor, attributes: tuple[str, ...] = ATTRIBUTES) -> Tensor:
    """What landmarks (..., A) add to a view's sums, (..., N_EXPECTED), by their log-odds of being found (...,)."""
    found = log_odds.sigmoid()[..., None]
    precision = bearing_precision(values, attributes)
    told = found if precision is None else found * precision[..., None]
    across, down = (values[..., attributes.index(name), None] for name in ("across", "down"))
    moments = torch.cat([across, down, across * across, across * down, down * down], -1)
    return torch.cat([found, told * bearing_numbers(values, attributes), found * moments], -1)
