"""A trained network over single landmarks with all that is needed to use it again, on disk and back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Self

from torch import nn

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.landmarks_in_view import ATTRIBUTES
from wheretolook.learning.landmark_views import AttributeStatistics
from wheretolook.learning.weights import check_kind, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, WeightsError


class LandmarkModel:
    """A network, the camera of its training views, and what makes its logits calibrated log-odds.

    Args:
        network: trained; has `statistics` and `options`, by which it can be built anew.
        camera: of the training views.
        scale, offset: calibrated log-odds are scale * logit + offset.

    Attributes:
        kind: the method that the weights serve, in the header of their file.
        network_class: what to build.
    """

    kind: ClassVar[str]
    network_class: ClassVar[type[nn.Module]]

    def __init__(self, network: nn.Module, camera: PinholeCamera, scale: float = 1.0, offset: float = 0.0) -> None:
        self.network: Any = network.eval()
        self.camera, self.scale, self.offset = camera, scale, offset

    def save(self, path: Path, training: dict[str, Any] | None = None) -> None:
        """Write one safetensors file, atomically. The same model gives the same bytes.

        Args:
            path: file to write; its folder is made when needed.
            training: what else to keep about the training (JSON values).
        """
        header = {
            "kind": self.kind, "attributes": list(ATTRIBUTES), "camera": asdict(self.camera),
            "statistics": asdict(self.network.statistics), "options": self.network.options,
            "scale": self.scale, "offset": self.offset, "training": training or {},
        }  # fmt: skip
        write_weights(path, self.network.state_dict(), header)

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> Self:
        """Read what `save` wrote.

        Raises:
            WeightsError: the file is missing, damaged, foreign, of another kind, or asks for other attributes.
        """
        tensors, header = read_weights(Path(path))
        check_kind(path, header, cls.kind)
        if header.get("attributes") != list(ATTRIBUTES):
            raise WeightsError("these weights ask for other attributes of a landmark", path=path, fix="Train again.")
        try:
            stored = header["statistics"]
            statistics = AttributeStatistics(tuple(stored["mean"]), tuple(stored["std"]))
            options = {
                name: tuple(value) if isinstance(value, list) else value for name, value in header["options"].items()
            }
            network = cls.network_class(statistics, **options)
            network.load_state_dict(tensors)
            camera, numbers = PinholeCamera(**header["camera"]), (float(header["scale"]), float(header["offset"]))
        except (KeyError, TypeError, ValueError, RuntimeError, ConfigError) as error:
            raise WeightsError(f"damaged weights: {error}", path=path, fix="Train again.") from error
        return cls(network.to(device).requires_grad_(False), camera, *numbers)
