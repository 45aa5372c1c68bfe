"""Scene-adapted weights: the base network, and the correction of its log-odds."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite
from typing import Any, Self

import torch

from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import StoredNetwork

MAX_SUPPORT = 1_000_000  # of views and landmarks: more are no weights of this program


class AdaptedNetwork(StoredNetwork):
    """A set network, its calibration, and a correction of its log-odds that depends on the pose.

    The correction at a pose is the sum over N localized views of `support_weights`, each times its kernel with the pose,
    see `wheretolook.scorers.adapted.kernel`. `place` holds some of the map's landmarks, by which the scene is recognized,
    in the map's frame in metres.
    """

    support_centers: torch.Tensor  # (N, 3) float64 m
    support_axes: torch.Tensor  # (N, 3) float64, unit optical axes
    support_weights: torch.Tensor  # (N,) float64, log-odds
    place: torch.Tensor  # (P, 3) float64 m

    def __init__(
        self, network: SetNetwork, scale: float, offset: float, length_m: float, sharpness: float, support: int,
        place: int,
    ) -> None:  # fmt: skip
        super().__init__()
        self.network = network
        self.base_scale = scale
        self.base_offset = offset
        self.length_m = length_m
        self.sharpness = sharpness
        shapes = {"support_centers": (support, 3), "support_axes": (support, 3), "support_weights": (support,)}
        for name, shape in {**shapes, "place": (place, 3)}.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))

    def description(self) -> dict[str, Any]:
        """See `StoredNetwork.description`."""
        base = {"network": self.network.description(), "scale": self.base_scale, "offset": self.base_offset}
        kernel = {"length_m": self.length_m, "sharpness": self.sharpness}
        return {"base": base, "kernel": kernel, "support": len(self.support_weights), "place": len(self.place)}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """See `StoredNetwork.of_description`."""
        base = stored["base"]
        kernel = stored["kernel"]
        sizes = int(stored["support"]), int(stored["place"])
        if not all(0 <= size <= MAX_SUPPORT for size in sizes):
            raise ValueError(f"there are at most {MAX_SUPPORT:,} views and landmarks, not {sizes}")
        length_m = float(kernel["length_m"])
        sharpness = float(kernel["sharpness"])
        if not (0 < length_m < inf and 0 <= sharpness < inf):
            raise ValueError(f"no length and sharpness of a kernel: {length_m}, {sharpness}")
        scale = float(base["scale"])
        offset = float(base["offset"])
        if not (isfinite(scale) and isfinite(offset)):
            raise ValueError(f"scale {scale} and offset {offset} are not finite")
        network = SetNetwork.of_description(base["network"])
        return cls(network, scale, offset, length_m, sharpness, *sizes)
