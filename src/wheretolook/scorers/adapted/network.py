"""Scene-adapted weights: the base network, its calibration, and landmarks of the scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import torch

from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import StoredNetwork, finite

MAX_PLACE = 1_000_000  # landmarks: more are no weights of this program


class AdaptedNetwork(StoredNetwork):
    """A set network and its calibration.

    `place` holds some of the map's landmarks, by which the scene is recognized, in the map's frame in metres.
    """

    place: torch.Tensor  # (P, 3) float64 m

    def __init__(self, network: SetNetwork, scale: float, offset: float, place: int) -> None:
        super().__init__()
        self.network = network
        self.base_scale = scale
        self.base_offset = offset
        self.register_buffer("place", torch.zeros((place, 3), dtype=torch.float64))

    def description(self) -> dict[str, Any]:
        """See `StoredNetwork.description`."""
        base = {"network": self.network.description(), "scale": self.base_scale, "offset": self.base_offset}
        return {"base": base, "place": len(self.place)}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """See `StoredNetwork.of_description`."""
        if "kernel" in stored:
            raise ValueError(
                "a Gaussian process, which is no longer applied, corrects them: run `wheretolook adapt` again"
            )
        base = stored["base"]
        place = int(stored["place"])
        if not 0 <= place <= MAX_PLACE:
            raise ValueError(f"invalid number of landmarks {place}")
        network = SetNetwork.of_description(base["network"])
        return cls(network, finite(base["scale"]), finite(base["offset"]), place)
