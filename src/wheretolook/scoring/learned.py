"""The learned score."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from wheretolook.camera_models import Camera, ColmapCamera
from wheretolook.errors import WeightsError
from wheretolook.features import ALL_CHANNELS, CHANNELS, BinnedViews
from wheretolook.geometry import Float, PinholeCamera
from wheretolook.learning.network import ViewpointNetwork
from wheretolook.learning.weights import best_weights, load_classifier, read_training, weights_kind
from wheretolook.localization_map import LocalizationMap
from wheretolook.scoring.base import BLOCK, BinnedScorer, Scorer

FIELD_OF_VIEW_TOLERANCE = 1e-3
"""Relative difference in width / focal length and height / focal length up to which fields of view are the same."""


class LearnedScorer(BinnedScorer):
    """The paper's classifier: the predicted probability that a view localizes.

    A network knows the field of view it was trained with. A camera of another resolution but the same field of view is
    served by scaling its pixels; another field of view is refused, since the network has never seen one.

    Args:
        localization_map: the map.
        network: a trained network.
        inputs: name of its variant, if it is not that of its inputs.
    """

    name: ClassVar[str] = "mlp"
    local = True

    def __init__(self, localization_map: LocalizationMap, network: ViewpointNetwork, inputs: str | None = None) -> None:
        super().__init__(localization_map, network.spec.bins, not {*network.spec.channels} <= {*CHANNELS})
        self.inputs = network.spec.variant if inputs is None else inputs
        self.device = localization_map.device
        self.network = network.to(self.device).eval()
        trained, camera = network.spec.camera, localization_map.camera
        check_field_of_view(trained, camera)
        self._channels = ALL_CHANNELS if self.landmark_channels else CHANNELS
        self._scale = torch.tensor(channel_scales(trained, camera, self._channels), device=self.device)[:, None, None]

    @classmethod
    def load(cls, weights: str | Path, localization_map: LocalizationMap) -> LearnedScorer:
        """Build a scorer from a weights file that the train stage wrote.

        Raises:
            WeightsError: the file cannot be used, or was trained for another field of view than the map's camera.
        """
        network = load_classifier(weights)
        with naming(weights):
            return cls(localization_map, network, read_training(weights).get("variant"))

    def score_bins(self, binned: BinnedViews) -> Float:
        """(B,) probabilities in [0, 1]."""
        binned = binned.select(self._channels) if binned.channels != self._channels else binned
        scores = np.empty(len(binned))
        with torch.inference_mode():
            for begin in range(0, len(scores), BLOCK):
                rows = slice(begin, begin + BLOCK)
                means = torch.from_numpy(binned.means[rows]).to(self.device) * self._scale
                filled = torch.from_numpy(binned.counts[rows] > 0).to(self.device)
                # float64 keeps views apart whose probabilities round to 1 in float32
                scores[rows] = self.network(means, filled).double().sigmoid().cpu().numpy()
        return scores


def load_scorer(weights: str | Path, localization_map: LocalizationMap) -> Scorer:
    """The learned scorer of weights for a map: `load_scorer(weights, map).score(cam_from_world)`.

    Args:
        weights: a file that the train stage wrote, in which stands what method it is; or a folder of such files, of
            which the one with the best validation average precision is taken.
        localization_map: what to score views of.

    Raises:
        WeightsError: the file cannot be used, or was trained for another field of view than the map's camera.
        MapError: the map lacks what the method needs.
    """
    from wheretolook.scoring.conv import ConvScorer
    from wheretolook.scoring.set import SetScorer
    from wheretolook.scoring.sphere import SphereScorer
    from wheretolook.scoring.trees import TreesScorer

    loaders: dict[str, Callable[[str | Path, LocalizationMap], Scorer]] = {
        scorer.name: scorer.load for scorer in (LearnedScorer, TreesScorer, ConvScorer, SetScorer, SphereScorer)
    }
    weights = best_weights(weights) if Path(weights).is_dir() else weights
    kind = weights_kind(weights)
    if kind not in loaders:
        known = f"Give weights of {', '.join(loaders)}."
        raise WeightsError("these weights are not of one scorer", path=weights, value=kind, fix=known)
    return loaders[kind](weights, localization_map)


def channel_scales(trained: PinholeCamera, camera: Camera, channels: tuple[str, ...]) -> list[float]:
    """What channels of a camera's views are multiplied by to be as those of the camera of the training views."""
    scale = {"u": trained.width / camera.width, "v": trained.height / camera.height}
    return [scale.get(name, 1.0) for name in channels]


@contextmanager
def naming(weights: str | Path) -> Iterator[None]:
    """Let a WeightsError name the file of the weights that are used."""
    try:
        yield
    except WeightsError as error:
        raise WeightsError(error.problem, path=weights, value=error.value, fix=error.fix) from None


def check_field_of_view(trained: PinholeCamera, camera: Camera) -> None:
    """Raise a WeightsError if a camera's field of view is not that of the camera of the training views."""
    if not same_field_of_view(trained, camera):
        raise WeightsError(
            f"the network was trained for a camera of {_describe(trained)}",
            value=_describe(camera),
            fix="Use a pinhole camera with that field of view, or train with this one.",
        )


def same_field_of_view(trained: PinholeCamera, camera: Camera) -> bool:
    """Whether weights trained for one camera serve another: image and focal length of the same proportions."""
    if isinstance(camera, ColmapCamera):
        return False
    spans = np.array([(one.width / one.focal_px, one.height / one.focal_px) for one in (trained, camera)])
    return bool(np.allclose(spans[0], spans[1], rtol=FIELD_OF_VIEW_TOLERANCE, atol=0))


def _describe(camera: Camera) -> str:
    if isinstance(camera, ColmapCamera):
        return f"{camera.width} x {camera.height} px, {camera.model}"
    across, down = (2 * np.degrees(np.arctan(side / 2 / camera.focal_px)) for side in (camera.width, camera.height))
    return f"{camera.width} x {camera.height} px, {across:.1f} x {down:.1f} degrees"
