"""Score all directions at locations by the set of their landmarks."""

from __future__ import annotations

from math import log
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor
from torch.nn.functional import pad

from wheretolook.dataset.config import Accuracy
from wheretolook.geometry.poses import Float, check_locations, rotation_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES
from wheretolook.scorers.set import directions_kernel
from wheretolook.scorers.set.accuracy import probabilities
from wheretolook.scorers.set.network import CELLS, SetNetwork, ViewSums, along
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.devices import in_threads
from wheretolook.utils.processes import cores
from wheretolook.visibility.counting import FrustumLister, choose_size
from wheretolook.visibility.occlusion import DevicePoints, morton_codes

OF_LOCATION = ("distance", "mapped_angle", "distance_ratio", "pixel_size_ratio")
"""Attributes of a landmark that depend on the camera's location, but not on its orientation."""

OF_IMAGE = ("across", "down")
"""Attributes of a landmark that depend on the camera's orientation."""


class BatchedDirections:
    """Scores the same directions (D, 3), unit vectors in the world, at any location.

    A view of more than `limit` landmarks is scored from every second, every fourth, and so on, along a curve through
    space (`DevicePoints`), see `FrustumLister`. On a GPU 8 lanes, that is threads, share the landmarks of a view.
    """

    def __init__(
        self,
        localization_map: LocalizationMap,
        trained: TrainedNetwork[SetNetwork],
        directions: Float,
        limit: int,
        accuracy: Accuracy,
        lanes: int | None = None,
    ) -> None:
        self.localization_map = localization_map
        self.trained = trained
        self.directions = directions
        self.limit = limit
        self.accuracy = accuracy
        self.points = DevicePoints(localization_map.landmarks.points, localization_map.device)
        self.order = np.argsort(morton_codes(directions))  # neighbours share landmarks, which stay in the cache
        # 64 at least: of larger cells too many are on the border of a view
        size = max(64, choose_size(len(self.points)))
        rotations = rotation_looking_along(directions[self.order])
        device = self.points.device
        camera = localization_map.camera
        self.lister = FrustumLister(camera, rotations, 0, device, size=size, scratch_bytes=1 << 24)
        with torch.inference_mode():
            self.network = self._network()
        self.lanes = lanes or (1 if device == "cpu" else 8)
        self._describe, self._sum = directions_kernel.kernels(self.network.bias.shape[0], self.lanes)
        self._open = len(self.points)  # about how many landmarks are unoccluded from a location
        self._edges: Any = wp.array(
            np.tan((np.arange(CELLS + 1) / CELLS - 0.5) * np.pi), dtype=wp.float64, device=device
        )
        wp.synchronize_device(device)  # Torch works on a stream of its own

    def _network(self) -> Any:
        """Return the `Matchability` of the map's landmarks."""
        landmarks = self.localization_map.landmarks
        matchability = self.trained.network.matchability
        names = matchability.attributes
        first, second, last = (layer for layer in matchability.layers if isinstance(layer, torch.nn.Linear))
        mean = matchability.input.mean
        pixel_angle = -log(self.localization_map.camera.mean_focal_px)
        more = -len(second.bias) % 8  # units without effect

        def upload(values: Tensor, dtype: Any = wp.float32) -> Any:
            return wp.from_torch(values.contiguous(), dtype=dtype)

        of_map = torch.from_numpy(landmarks.attributes()[self.points.order]).to(mean.device)
        # the first layer of what depends on the map alone: the other columns are at their means, so 0
        values = mean.repeat(len(of_map), 1)
        for column, name in enumerate(names):
            if name in MAP_ATTRIBUTES:
                values[:, column] = of_map[:, MAP_ATTRIBUTES.index(name)]
            elif name == "pixel_angle":
                values[:, column] = pixel_angle
        weight = first.weight * matchability.input.scale
        of_image = _columns(weight, names, OF_IMAGE)
        # the kernels give `across` and `down` as they are: their means are subtracted here
        means_of_image = _columns(mean[None], names, OF_IMAGE)[:, 0] @ of_image
        mapped = [MAP_ATTRIBUTES.index(name) for name in ("mapped_distance", "mapped_pixel_size")]
        mapped_from = torch.from_numpy(landmarks.mapping_direction[self.points.order]).to(mean.device)
        track, spread = (of_map[:, [MAP_ATTRIBUTES.index(name)]] for name in ("track_length", "direction_spread"))
        network: Any = directions_kernel.Matchability()
        network.first = upload(pad(first(matchability.input(values)) - means_of_image, (0, more)))
        network.of_location = upload(pad(_columns(weight, names, OF_LOCATION), (0, more)))
        network.of_image = upload(pad(of_image, (0, more)))
        network.second = upload(pad(second.weight.T, (0, more, 0, more)))
        network.bias = upload(pad(second.bias, (0, more)))
        network.last = upload(torch.cat([pad(last.weight[0], (0, more)), last.bias]))
        network.mean = wp.vec4(*_columns(mean[None], names, OF_LOCATION)[:, 0].tolist())
        network.pixel_angle = pixel_angle
        parts = [mapped_from, of_map[:, mapped], (-track).exp(), along(spread)]
        network.mapped = upload(torch.cat(parts, 1), directions_kernel.Mapped)
        network.reach = wp.vec2(*self._reach())
        return network

    def _reach(self) -> Float:
        """Return the largest positions in an image (2,), across and down, if they are finite."""
        camera = self.localization_map.camera
        along = np.linspace(0, 1, 65)
        pixels = np.stack(np.meshgrid(along * camera.width, along * camera.height), axis=-1)
        rays = camera.unproject(pixels.reshape(-1, 2))
        if not (rays[:, 2] > 0.01).all():  # or NaN
            return np.full(2, 1e30)
        # between these points a curved side may reach a little farther
        return 1.01 * np.abs(rays[:, :2] / rays[:, 2:]).max(axis=0)

    def score(self, locations: Float) -> tuple[Float, Float]:
        """Return scores and landmarks in view (L, D) at locations (L, 3) m; a PoseError if one is not finite.

        Where only a camera of COLMAP can decide what is in view, and a part is listed, their number is estimated.
        """
        locations = check_locations(locations)
        n_points = len(self.points)
        found = np.empty((2, len(locations), len(self.directions)))
        workers = 1
        if self.points.device == "cpu":  # blocks are small: each thread has its own
            workers = cores()
            step = min((1 << 17) // max(1, n_points), -(-len(locations) // (4 * workers)))
        else:  # 30,000 bytes for a view's list and cells; what is unoccluded takes at most 14 times all of it
            required = self.lister.bytes_per_location(n_points) + 30_000 * len(self.directions)
            memory = wp.get_device(self.points.device).total_memory // 32
            step = min(memory // required, self.lister.max_locations(n_points))

        def work(rows: slice) -> None:
            torch.set_num_threads(1)
            found[:, rows, self.order] = self._score(locations[rows])

        threads = torch.get_num_threads()
        step = max(1, step)
        try:
            blocks = [slice(begin, begin + step) for begin in range(0, len(locations), step)]
            list(in_threads(work, blocks, workers))
        finally:
            torch.set_num_threads(threads)
        return found[0], found[1]

    def _score(self, locations: Float) -> Float:
        """Return scores and landmarks in view (2, L, D) of the directions in `order`."""
        device = self.points.device
        mask = self.localization_map.occlusion.unoccluded_on_device(locations, self.points)
        nearby = self.lister.surroundings(locations, self.points.double, mask)
        views = np.stack(np.divmod(np.arange(len(locations) * len(self.directions)), len(self.directions)), axis=1)
        listed = self.lister.list(nearby, views, self.limit)

        def empty(*shape: int, dtype: Any = wp.float32) -> Any:
            return wp.empty(shape, dtype=dtype, device=device)

        number = len(nearby.rows)
        width = self.network.bias.shape[0]
        described: Any = directions_kernel.Described()
        described.n_open = empty(number, dtype=wp.int32)
        described.terms = empty(number, dtype=directions_kernel.Sums)
        if self.lanes > 1:
            described.open, described.layers = empty(1, 1, dtype=wp.uint8), empty(width, number)
        else:
            described.open, described.layers = empty(number, width, dtype=wp.uint8), empty(number, 6 * width)
        wp.launch(self._describe, number, [self.network, nearby.offsets, nearby.rows], [described], device=device)
        numbers: Any = (listed.n_visible, listed.starts, listed.lengths)
        uploaded: Any = [wp.array(values, device=device) for values in numbers]
        visible, starts, lengths = uploaded
        none: Any = wp.full((len(views), CELLS**2), float(self.lanes == 1), dtype=wp.float32, device=device)
        sums, cells = empty(len(views), self.lanes, dtype=directions_kernel.Sums), empty(len(views))
        inputs = [self.network, described, starts, lengths, listed.entries, listed.image, visible, self._edges, none]
        wp.launch(self._sum, sums.shape, inputs, [sums, cells], device=device)
        wp.synchronize_device(device)  # Torch works on a stream of its own
        seen, summed, in_cells = (wp.to_torch(array) for array in (visible, sums, cells))
        each = (seen / wp.to_torch(lengths).clamp(min=1))[:, None]
        if self.lanes > 1:
            in_cells = -torch.expm1(wp.to_torch(none) * each).sum(1)
        scores = probabilities(self.trained, self.accuracy, ViewSums(summed.sum(1) * each, seen, in_cells))
        return np.stack([scores, listed.n_visible]).reshape(2, len(locations), -1)


def _columns(weight: Tensor, names: tuple[str, ...], wanted: tuple[str, ...]) -> Tensor:
    """Return columns of a weight (W, A) by name, transposed (len(wanted), W); 0 for attributes it does not have."""
    zero = torch.zeros_like(weight[:, 0])
    return torch.stack([weight[:, names.index(name)] if name in names else zero for name in wanted])
