"""Scene-adapted weights: the base network, and the correction of its log-odds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import torch

from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import StoredNetwork, finite

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
        calibration = finite(base["scale"]), finite(base["offset"])
        length_m, sharpness = (finite(stored["kernel"][name]) for name in ("length_m", "sharpness"))
        sizes = int(stored["support"]), int(stored["place"])
        if length_m <= 0 or sharpness < 0 or not all(0 <= size <= MAX_SUPPORT for size in sizes):
            raise ValueError(f"invalid kernel {stored['kernel']}, or numbers of views and landmarks {sizes}")
        return cls(SetNetwork.of_description(base["network"]), *calibration, length_m, sharpness, *sizes)
