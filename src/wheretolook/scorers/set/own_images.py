"""Calibrate a set network to a map of photographs by what its own images observe."""

from __future__ import annotations

from bisect import bisect_left
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch

from wheretolook.inputs.landmark_features import LandmarkDescriber
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import observation_matrix, select_points
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.visibility.cached_occlusion import CachedOcclusion
from wheretolook.visibility.occlusion import StoredOcclusion

MIN_IMAGES = 5  # of a map whose tracks show how often landmarks are detected
BLOCKS = 8  # of images that are held out one after the other
SHARE = 1 / 8  # of the images that a block takes
TESTED = 2  # images of a block, at most
MAX_POINTS = 20_000  # of the map that are examined, evenly spread
MIN_OBSERVED = 50  # observations of remaining landmarks in the held-out images
MAX_LANDMARKS = 512  # of an image that are described
OFFSETS = np.linspace(-1, 2, 61).tolist()


def for_map(trained: TrainedNetwork[SetNetwork], localization_map: LocalizationMap) -> TrainedNetwork[SetNetwork]:
    """Return a network calibrated for a map of photographs; the same network for a map of renders.

    The log-odds of detection get `detection_offset`, those of the view `TrainedNetwork.photograph_offset`.
    """
    if not localization_map.photographs:
        return trained
    network = deepcopy(trained.network)
    last = network.matchability.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        last.bias.add_(_known_offset(network, localization_map))
    return replace(trained.for_photographs(), network=network)


def _known_offset(network: SetNetwork, localization_map: LocalizationMap) -> float:
    """Return `detection_offset`, estimated once for all cameras and parts of a map."""
    if localization_map.images is None:
        return 0.0
    known = localization_map.images.offsets
    occlusion = localization_map.occlusion
    if isinstance(occlusion, CachedOcclusion):
        occlusion = occlusion.model
    if isinstance(occlusion, StoredOcclusion):  # of all landmarks at some locations only
        return 0.0
    key = (occlusion, *(float(values.sum()) for values in network.parameters()))
    if key not in known:
        known[key] = detection_offset(network, localization_map)
    return known[key]


def detection_offset(network: SetNetwork, localization_map: LocalizationMap) -> float:
    """Estimate the offset of a network's log-odds of detection on a map from the tracks of its landmarks.

    Blocks of images that share landmarks are held out. With the offset, the network predicts as many detections of the
    remaining landmarks as there are observations of them in the held-out images. 0 if the images are unknown, fewer
    than `MIN_IMAGES`, or observe hardly any of these landmarks. Measured in docs/research/cameras.md.
    """
    images = localization_map.images
    if images is None or len(images) < MIN_IMAGES:
        return 0.0
    kept = np.zeros(len(images.arrays.points), dtype=bool)
    kept[:: max(1, -(-len(kept) // MAX_POINTS))] = True
    images = replace(images, arrays=select_points(images.arrays, kept))
    observes = observation_matrix(images.arrays)
    n_observed = 0.0
    parts: list[tuple[torch.Tensor, torch.Tensor]] = []
    seeing = np.flatnonzero(np.asarray(observes.sum(1)).reshape(-1))
    for first in seeing[_spread(len(seeing), BLOCKS)]:
        common = (observes @ observes[[first]].T).toarray().reshape(-1)
        block = np.argsort(-common, kind="stable")[: max(1, round(len(images) * SHARE))]
        block = block[common[block] > 0]
        remaining = images.without(block)
        if len(remaining) == 0:
            continue
        describer = LandmarkDescriber(replace(localization_map, landmarks=remaining), network.attributes)
        tested = block[_spread(len(block), TESTED)]
        n_observed += observes[tested][:, np.isin(images.arrays.point_ids, remaining.ids)].sum()
        for row in tested:
            views = describer.of_camera(images.cameras[row]).in_blocks(images.poses[[row]], MAX_LANDMARKS)
            for _, described, n_visible in views:
                with torch.inference_mode():
                    log_odds = network.matchability(described.values).double()
                parts.append((log_odds, (n_visible / max(1, len(log_odds))).expand(len(log_odds))))
    if n_observed < MIN_OBSERVED:
        return 0.0
    log_odds, weights = (torch.cat(part) for part in zip(*parts, strict=True))

    def surplus(offset: float) -> float:
        return float((weights * (log_odds + offset).sigmoid()).sum()) - n_observed

    return OFFSETS[min(bisect_left(OFFSETS, 0.0, key=surplus), len(OFFSETS) - 1)]


def _spread(n: int, max_count: int) -> np.ndarray:
    """Return at most so many evenly spread rows of n."""
    return np.unique(np.linspace(0, n - 1, min(max_count, n)).round().astype(int))
