"""Score all directions at a location at once, computing what depends on the location only once.

Only a landmark's position in the image depends on the camera's orientation. The rest of the first layer, and the
landmark's information on the pose, serve all directions at the location. The information is summed along the world's
axes, which leaves the variances that the network uses unchanged.
"""

from __future__ import annotations

import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from math import log
from threading import Lock
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from wheretolook.geometry.poses import Float, check_locations, rotation_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.scorers.matchability.network import N_EXPECTED, bearing_precision
from wheretolook.scorers.set.network import SetNetwork, expected_cells
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.visibility.listing import FrustumLister, ListedViews, Surroundings
from wheretolook.visibility.occlusion import DevicePoints
from wheretolook.visibility.sphere_cells import choose_size

SERVED = {
    "log_expected_inliers",
    "log_visible",
    "expected_share",
    "log_position_variance",
    "log_orientation_variance",
    "log_det_information",
    "axis_height",
    "log_expected_cells",
}
"""Statistics of a view that do not depend on the camera's axes."""

OF_LOCATION = ("distance", "mapped_angle", "distance_ratio", "pixel_size_ratio")
"""Attributes of a landmark that depend on the camera's location, but not on its orientation."""

IMAGE = ("across", "down")
"""Attributes of a landmark that depend on the camera's orientation."""

ROOM = {"cpu": 1 << 13, "cuda": 1 << 22}  # landmarks in view that pass the network at once: fits the cache, or 2 GB
NEARBY = {"cpu": 1, "cuda": 1 << 23}  # landmarks around the locations of a block; of a location at least
SCRATCH_BYTES = 1 << 24
LEAST_CELLS = 64  # along a side of the sphere's map: of larger cells too many lie on the border of a view


class BatchedDirections:
    """Scores the same directions (D, 3), unit vectors in the world, at any location.

    A view of more than `most` landmarks is scored from every second of the map's, every fourth, and so on, along a
    curve through space (`DevicePoints`), so that between half of `most` and `most` remain.
    """

    def __init__(
        self, localization_map: LocalizationMap, trained: TrainedNetwork[SetNetwork], directions: Float, most: int
    ) -> None:
        self.localization_map = localization_map
        self.trained = trained
        self.directions = directions
        self.most = most
        nearby = localization_map
        matchability = trained.network.matchability
        self.rotations = rotation_looking_along(directions)
        self.points = DevicePoints(nearby.landmarks.points, nearby.device)
        names = matchability.attributes
        first, self._second, self._last = (layer for layer in matchability.layers if isinstance(layer, torch.nn.Linear))
        self.device = matchability.input.mean.device
        with torch.inference_mode():
            weight = first.weight * matchability.input.scale
            self._of_image = self._weight(weight, names, IMAGE)
            self._of_location = self._weight(weight, names, OF_LOCATION)
            of_map = torch.from_numpy(nearby.landmarks.attributes()[self.points.order]).to(self.device)
            self._mean = self._weight(matchability.input.mean[None], names, OF_LOCATION)[:, 0]
            self._pixel_angle = -log(nearby.camera.mean_focal_px)
            # the first layer of what neither location nor image tells: the other columns are at their means, so 0
            values = matchability.input.mean.repeat(len(of_map), 1)
            for column, name in enumerate(names):
                if name in MAP_ATTRIBUTES:
                    values[:, column] = of_map[:, MAP_ATTRIBUTES.index(name)]
                elif name == "pixel_angle":
                    values[:, column] = self._pixel_angle
            # `across` and `down` are given as they are: their means are taken off here
            self._first = (
                first(matchability.input(values))
                - self._weight(matchability.input.mean[None], names, IMAGE)[:, 0] @ self._of_image
            )
            mapped = [MAP_ATTRIBUTES.index(name) for name in ("mapped_distance", "mapped_pixel_size")]
            mapped_from = torch.from_numpy(nearby.landmarks.mapping_direction[self.points.order]).to(self.device)
            self._mapped = torch.cat([mapped_from, of_map[:, mapped]], 1)
        self._asks_for_cells = "log_expected_cells" in trained.network.options["told"]
        with warnings.catch_warnings():  # PyTorch says once that sparse matrices are young
            warnings.simplefilter("ignore")
            torch.sparse_csr_tensor(
                torch.zeros(1, dtype=torch.int32), torch.zeros(0, dtype=torch.int32), torch.zeros(0)
            )
        self._listers: dict[int, FrustumLister] = {}
        self._lock = Lock()

    @staticmethod
    def serves(network: SetNetwork) -> bool:
        """Whether a network is told of views only what is `SERVED`."""
        return network.attention is None and {*network.options["told"]} <= SERVED

    @staticmethod
    def _weight(weight: Tensor, names: tuple[str, ...], wanted: tuple[str, ...]) -> Tensor:
        """Columns of a weight (W, A) by name, transposed (len(wanted), W); 0 for attributes it does not have."""
        zero = torch.zeros_like(weight[:, 0])
        return torch.stack([weight[:, names.index(name)] if name in names else zero for name in wanted])

    def score(self, locations: Float) -> Float:
        """Scores (L, D) at locations (L, 3) m. Raises PoseError if one is not finite."""
        locations = check_locations(locations)
        scores = np.empty((len(locations), len(self.rotations)))
        step = max(1, NEARBY[self.device.type] // max(1, len(self.points)))
        blocks = [slice(begin, begin + step) for begin in range(0, len(locations), step)]

        def work(rows: slice) -> None:
            with torch.inference_mode():
                scores[rows] = self._score(locations[rows])

        if self.device.type != "cpu":
            for rows in blocks:
                work(rows)
            return scores
        threads = torch.get_num_threads()
        pool = ThreadPoolExecutor(len(os.sched_getaffinity(0)), initializer=torch.set_num_threads, initargs=(1,))
        try:
            with pool:  # blocks are small: each thread has its own
                list(pool.map(work, blocks))
        finally:
            torch.set_num_threads(threads)
        return scores

    def _score(self, locations: Float) -> Float:
        n_directions = len(self.rotations)
        double = self.points.double
        mask = self.localization_map.occlusion.unoccluded_on_device(locations, self.points)
        pairs = np.stack(np.divmod(np.arange(len(locations) * n_directions), n_directions), axis=1)
        lister = self._lister(0)
        nearby = lister.surroundings(locations, double, mask)
        in_view = lister.lengths(nearby, pairs)
        halvings = np.ceil(np.log2(np.maximum(in_view, 1) / self.most)).clip(0).astype(int)
        scores = np.empty(len(pairs))
        for level in np.unique(halvings):
            stride = 1 << int(level)
            views = np.flatnonzero(halvings == level)
            lengths = in_view[views]
            if level:
                lister = self._lister(int(level))
                part = None if mask is None else mask[:, ::stride].contiguous()
                nearby = lister.surroundings(locations, double[::stride].contiguous(), part)
                lengths = lister.lengths(nearby, pairs[views])
            listed = lister.list(nearby, pairs[views], lengths)
            # the share of a sample that the camera does see, where that is for the camera to say, is that of all
            n_visible = np.diff(listed.starts) / np.maximum(lengths, 1) * in_view[views]
            if self.device.type != "cpu":
                wp.synchronize_device(self.points.device)  # Torch works on a stream of its own
            scores[views] = self._of_listed(listed, nearby, stride, n_visible, self.directions[pairs[views, 1], 2])
        return scores.reshape(-1, n_directions)

    def _lister(self, level: int) -> FrustumLister:
        with self._lock:
            if level not in self._listers:
                camera = self.localization_map.camera
                n_points = len(self.points) >> level
                options: dict[str, Any] = {
                    "scratch_bytes": SCRATCH_BYTES,
                    "size": max(LEAST_CELLS, choose_size(n_points)),
                }
                self._listers[level] = FrustumLister(camera, self.rotations, n_points, self.points.device, **options)
            return self._listers[level]

    def _of_listed(
        self, listed: ListedViews, nearby: Surroundings, stride: int, n_visible: Float, heights: Float
    ) -> Float:
        """Return scores (V,) of listed views of `n_visible` (V,) landmarks in all, whose axes have z `heights` (V,)."""
        network = self.trained.network
        starts = listed.starts
        entries = wp.to_torch(listed.entries)
        image = wp.to_torch(listed.image)
        offsets = wp.to_torch(nearby.offsets)
        rows = wp.to_torch(nearby.rows)
        used = torch.zeros(len(rows), dtype=torch.bool, device=self.device)
        used[entries] = True
        place = used.cumsum(0, dtype=torch.int32) - 1
        seen = used.nonzero()[:, 0]
        base, terms = self._described(offsets[seen], rows[seen] * stride)
        n = len(n_visible)
        kept = torch.from_numpy(np.diff(starts)).to(self.device).clamp(min=1)
        sums = torch.zeros((n, N_EXPECTED), device=self.device)
        cells = torch.zeros(n, device=self.device)
        visible = torch.from_numpy(n_visible).to(sums)
        height = torch.from_numpy(heights).to(sums)
        each = visible / kept
        weight = self._second.weight.T
        bias = self._second.bias
        last = self._last
        begin = 0
        while begin < n:
            end = int(np.searchsorted(starts, starts[begin] + ROOM[self.device.type], side="right")) - 1
            end = min(max(end, begin + 1), n)
            span = slice(int(starts[begin]), int(starts[end]))
            views = slice(begin, end)
            here = place[entries[span]]
            hidden = base.index_select(0, here).addmm_(image[span], self._of_image).relu_()
            hidden = torch.mm(hidden, weight).add_(bias).relu_()
            log_odds = torch.mv(hidden, last.weight[0]).add_(last.bias)
            lengths = torch.from_numpy((starts[begin : end + 1] - starts[begin]).astype(np.int32)).to(self.device)
            p_detect = torch.sparse_csr_tensor(lengths, here, log_odds.sigmoid(), size=(end - begin, len(terms)))
            sums[views, :16] = p_detect @ terms
            if self._asks_for_cells:
                of_view = torch.arange(end - begin, device=self.device).repeat_interleave(lengths.diff())
                cells[views] = expected_cells(image[span], log_odds, of_view, each[views], IMAGE)
            begin = end
        spread = cells if self._asks_for_cells else None
        logits = network.logits(sums * each[:, None], visible, height, spread).double()
        return np.asarray(self.trained.calibrated(logits).sigmoid().cpu().numpy())

    def _described(self, offsets: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first layer (M, W) of landmarks without their position in the image, and their terms of sums (M, 16).

        The landmarks are at offsets (M, 3) m from the location, and at rows (M,) of the points.
        """
        mapped = self._mapped[rows]
        distance = offsets.norm(dim=1)
        log_distance = distance.log()
        bearing = offsets / distance[:, None]
        angle = (bearing * mapped[:, :3]).sum(1)
        size_ratio = log_distance + self._pixel_angle - mapped[:, 4]
        values = torch.stack([log_distance, angle, log_distance - mapped[:, 3], size_ratio], 1)
        base = self._first[rows].addmm_((values - self._mean).nan_to_num_(nan=0.0), self._of_location)
        pixels = torch.stack([torch.full_like(size_ratio, self._pixel_angle), size_ratio], 1)
        weight = bearing_precision(pixels, ("pixel_angle", "pixel_size_ratio"))
        x, y, z = bearing.unbind(1)
        terms = torch.empty((len(x), 16), device=self.device)
        terms[:, 0] = 1
        plane = terms[:, 10:]
        for column, number in enumerate((1 - x * x, -x * y, -x * z, 1 - y * y, -y * z, 1 - z * z)):
            torch.mul(number, weight, out=plane[:, column])
        inverse = distance.reciprocal()
        torch.mul(plane, inverse.square()[:, None], out=terms[:, 1:7])
        torch.mul(bearing, (inverse * weight)[:, None], out=terms[:, 7:10])
        return base, terms
