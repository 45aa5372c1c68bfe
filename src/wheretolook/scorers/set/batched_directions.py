"""Score all directions at a location at once, computing what depends on the location only once.

Only a landmark's position in the image depends on the camera's orientation. The rest of the first layer, and the
landmark's information on the pose, serve all directions at the location. The information is summed along the world's
axes, which leaves the variances that the network uses unchanged.
"""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from math import log
from threading import Lock

import numpy as np
import torch
import warp as wp
from torch import Tensor

from wheretolook.dataset.config import Accuracy
from wheretolook.geometry.poses import Float, check_locations, rotation_looking_along
from wheretolook.inputs.landmark_features import ragged_blocks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES
from wheretolook.scorers.matchability.network import N_EXPECTED, bearing_precision
from wheretolook.scorers.set.accuracy import probabilities
from wheretolook.scorers.set.network import SetNetwork, expected_cells
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.processes import cores
from wheretolook.visibility.counting import FrustumLister, ListedViews, Surroundings, choose_size
from wheretolook.visibility.occlusion import DevicePoints

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

AT_ONCE = {"cpu": 1 << 13, "cuda": 1 << 22}  # visible landmarks in a block: fits the cache, or takes 2 GB
NEARBY = {"cpu": 1, "cuda": 1 << 23}  # landmarks times locations in a block; of one location at least
SCRATCH_BYTES = 1 << 24
MIN_CELLS = 64  # along a side of the sphere's map: of larger cells too many are on the border of a view


class BatchedDirections:
    """Scores the same directions (D, 3), unit vectors in the world, at any location.

    A view of more than `limit` landmarks is scored from every second of the map's, every fourth, and so on, along a
    curve through space (`DevicePoints`), so that between half of `limit` and `limit` remain.
    """

    def __init__(
        self,
        localization_map: LocalizationMap,
        trained: TrainedNetwork[SetNetwork],
        directions: Float,
        limit: int,
        accuracy: Accuracy,
    ) -> None:
        self.localization_map = localization_map
        self.trained = trained
        self.directions = directions
        self.limit = limit
        self.accuracy = accuracy
        self.rotations = rotation_looking_along(directions)
        landmarks = localization_map.landmarks
        matchability = trained.network.matchability
        self.points = DevicePoints(landmarks.points, localization_map.device)
        names = matchability.attributes
        first, self._second, self._last = (layer for layer in matchability.layers if isinstance(layer, torch.nn.Linear))
        mean = matchability.input.mean
        self.device = mean.device
        self._pixel_angle = -log(localization_map.camera.mean_focal_px)
        with torch.inference_mode():
            weight = first.weight * matchability.input.scale
            self._of_image = _columns(weight, names, IMAGE)
            self._of_location = _columns(weight, names, OF_LOCATION)
            self._mean = _columns(mean[None], names, OF_LOCATION)[:, 0]
            of_map = torch.from_numpy(landmarks.attributes()[self.points.order]).to(self.device)
            # the first layer of what depends on the map alone: the other columns are at their means, so 0
            values = mean.repeat(len(of_map), 1)
            for column, name in enumerate(names):
                if name in MAP_ATTRIBUTES:
                    values[:, column] = of_map[:, MAP_ATTRIBUTES.index(name)]
                elif name == "pixel_angle":
                    values[:, column] = self._pixel_angle
            # the kernels give `across` and `down` as they are: their means are subtracted here
            means_of_image = _columns(mean[None], names, IMAGE)[:, 0] @ self._of_image
            self._first = first(matchability.input(values)) - means_of_image
            mapped = [MAP_ATTRIBUTES.index(name) for name in ("mapped_distance", "mapped_pixel_size")]
            mapped_from = torch.from_numpy(landmarks.mapping_direction[self.points.order]).to(self.device)
            self._mapped = torch.cat([mapped_from, of_map[:, mapped]], 1)
        with warnings.catch_warnings():  # PyTorch warns once that sparse matrices are new
            warnings.simplefilter("ignore")
            torch.sparse_csr_tensor([0, 0], [], [], size=(1, 1))
        self._listers: dict[int, FrustumLister] = {}  # by the number of cells along a side
        self._lock = Lock()

    @staticmethod
    def serves(network: SetNetwork) -> bool:
        """Return whether the inputs of a network's head are only what is `SERVED`."""
        return network.attention is None and {*network.view_statistics} <= SERVED

    def score(self, locations: Float) -> Float:
        """Return scores (L, D) at locations (L, 3) m; a PoseError if one is not finite."""
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
        pool = ThreadPoolExecutor(cores(), initializer=torch.set_num_threads, initargs=(1,))
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
        halvings = np.ceil(np.log2(np.maximum(in_view, 1) / self.limit)).clip(0).astype(int)
        scores = np.empty(len(pairs))
        for level in np.unique(halvings).tolist():
            stride = 1 << level
            views = np.flatnonzero(halvings == level)
            lengths = in_view[views]
            if level:
                lister = self._lister(level)
                part = None if mask is None else mask[:, ::stride].contiguous()
                nearby = lister.surroundings(locations, double[::stride].contiguous(), part)
                lengths = lister.lengths(nearby, pairs[views])
            listed = lister.list(nearby, pairs[views], lengths)
            # where the camera itself excludes landmarks, the share of a sample that remains is that of all
            n_visible = np.diff(listed.starts) / np.maximum(lengths, 1) * in_view[views]
            if self.device.type != "cpu":
                wp.synchronize_device(self.points.device)  # Torch works on a stream of its own
            scores[views] = self._of_listed(listed, nearby, stride, n_visible, self.directions[pairs[views, 1], 2])
        return scores.reshape(-1, n_directions)

    def _lister(self, level: int) -> FrustumLister:
        """The lister for every 2^level-th landmark. Few landmarks share one: to make its cells takes 70 ms of a core."""
        size = max(MIN_CELLS, choose_size(len(self.points) >> level))
        with self._lock:
            if size not in self._listers:
                camera = self.localization_map.camera
                options = {"scratch_bytes": SCRATCH_BYTES, "size": size}
                self._listers[size] = FrustumLister(camera, self.rotations, 0, self.points.device, **options)
            return self._listers[size]

    def _of_listed(
        self, listed: ListedViews, nearby: Surroundings, stride: int, n_visible: Float, heights: Float
    ) -> Float:
        """Return scores (V,) of listed views of `n_visible` (V,) landmarks in all, whose axes have z `heights` (V,)."""
        starts = listed.starts
        entries = wp.to_torch(listed.entries)
        image = wp.to_torch(listed.image)
        rows = wp.to_torch(nearby.rows)
        used = torch.zeros(len(rows), dtype=torch.bool, device=self.device)
        used[entries] = True
        place = used.cumsum(0, dtype=torch.int32) - 1
        seen = used.nonzero()[:, 0]
        base, terms = self._described(wp.to_torch(nearby.offsets).index_select(0, seen), rows[seen] * stride)
        sums = torch.zeros((len(n_visible), N_EXPECTED), device=self.device)
        cells = torch.zeros(len(n_visible), device=self.device)
        visible = torch.from_numpy(n_visible).to(sums)
        each = visible / torch.from_numpy(np.diff(starts)).to(self.device).clamp(min=1)
        for views in ragged_blocks(starts, AT_ONCE[self.device.type]):
            part = starts[views.start : views.stop + 1]
            span = slice(int(part[0]), int(part[-1]))
            here = place[entries[span]]
            hidden = base.index_select(0, here).addmm_(image[span], self._of_image).relu_()
            hidden = torch.mm(hidden, self._second.weight.T).add_(self._second.bias).relu_()
            log_odds = torch.mv(hidden, self._last.weight[0]).add_(self._last.bias)
            ends = torch.from_numpy((part - part[0]).astype(np.int32)).to(self.device)
            p_detect = torch.sparse_csr_tensor(ends, here, log_odds.sigmoid(), size=(len(part) - 1, len(terms)))
            sums[views, :16] = p_detect @ terms
            of_view = torch.arange(len(part) - 1, device=self.device).repeat_interleave(ends.diff())
            cells[views] = expected_cells(image[span], log_odds, of_view, each[views], IMAGE)
        height = torch.from_numpy(heights).to(sums)
        return probabilities(self.trained, self.accuracy, sums * each[:, None], visible, height, cells)

    def _described(self, offsets: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first layer (M, W) of landmarks without their position in the image, and their terms of sums (M, 16).

        The landmarks are at offsets (M, 3) m from the location, and at rows (M,) of the points.
        """
        mapped = self._mapped.index_select(0, rows)
        distance = offsets.norm(dim=1)
        log_distance = distance.log()
        bearing = offsets / distance[:, None]
        angle = (bearing * mapped[:, :3]).sum(1)
        size_ratio = log_distance + self._pixel_angle - mapped[:, 4]
        values = torch.stack([log_distance, angle, log_distance - mapped[:, 3], size_ratio], 1)
        base = self._first.index_select(0, rows).addmm_((values - self._mean).nan_to_num_(nan=0.0), self._of_location)
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


def _columns(weight: Tensor, names: tuple[str, ...], wanted: tuple[str, ...]) -> Tensor:
    """Return columns of a weight (W, A) by name, transposed (len(wanted), W); 0 for attributes it does not have."""
    zero = torch.zeros_like(weight[:, 0])
    return torch.stack([weight[:, names.index(name)] if name in names else zero for name in wanted])
