"""Plan photographs that extend a map: in pairs, since a landmark needs two, of which one registers in the map so far."""

from __future__ import annotations

import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array, vstack
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import expit, log_expit

from wheretolook.evaluation.statistics import ClusterBootstrap
from wheretolook.extend.surface import Surface, mapping_views
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.views import Views
from wheretolook.localization.confidence import RIGHT_PLACE_LIMITS
from wheretolook.mapping.colmap_model import observation_matrix
from wheretolook.scorers.base import Scorer
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, SceneError


@dataclass(frozen=True, eq=False)
class Extension:
    """Photographs to add to a map, in the order to take them.

    Attributes:
        views: the photographs, in the map's own frame, with the columns that `Views` has for them.
        targets: the target views, in the map's own frame; `score` is on the present map.
        predicted: (T,) probability that each localizes with all of the photographs.
        surface: what the surface of the place is known from: mesh, depth images or landmarks.
        correlation: between the score of target views and what is predicted from the surface that the map covers.
    """

    views: Views
    targets: Views
    predicted: Float
    surface: str
    correlation: float


def fit_coverage(coverage: Float, scores: Float) -> tuple[float, float]:
    """Fit scores (T,) by a logistic function of the covered share of views (T,).

    Returns its offset and its slope, which is positive.
    """

    def loss(values: Float) -> float:
        odds = values[0] + np.exp(values[1]) * coverage
        # where all views are covered alike, the slope of most maps
        prior = 0.01 * (values[1] - np.log(6.0)) ** 2
        return float(-(scores * log_expit(odds) + (1 - scores) * log_expit(-odds)).mean() + prior)

    offset, log_slope = minimize(loss, (-2.0, np.log(6.0)), method="Nelder-Mead").x
    return float(offset), float(np.exp(log_slope))


def raised(scores: Float, fitted: tuple[float, float], before: Float, now: Float) -> Float:
    """Return scores changed as a fitted function of covered shares does, from those before to those now."""
    offset, slope = fitted
    return np.clip(scores + expit(offset + slope * now) - expit(offset + slope * before), 0, 1)


class Planner:
    """Gains of candidate photographs (C, 3, 4) for target views with scores and places, in the map's own frame.

    Candidates are in the world.

    Everything is counted in patches of surface: one is mapped if at least two images cover it, see `Surface.covering`.
    """

    def __init__(self, scorer: Scorer, space: Any, targets: Views, candidates: Float) -> None:
        self.scorer = scorer
        self.registration = scorer  # a photograph registers if it is at the right place, less than a robot needs
        with suppress(ConfigError):  # the method has scores of one accuracy only
            self.registration = scorer.at_accuracy(RIGHT_PLACE_LIMITS)
        self.targets = targets
        self.surface = Surface(scorer.localization_map, space)
        self.images, self.cameras = mapping_views(scorer.localization_map)
        self._warn_of_parts()
        self.candidates = candidates[~self._taken(candidates)]
        n = len(self.candidates)
        if n == 0:
            fix = "Widen --height or --pitch."
            raise SceneError("all photographs that can be taken are in the map", value=len(candidates), fix=fix)
        self.camera = scorer.localization_map.camera
        to_world = scorer.localization_map.frame.world_from_map
        self.patches = self.surface.patches(to_world.apply_to_poses(targets.cam_from_world), 10, 8)
        covers = self.surface.covering(self.patches, self.candidates, [self.camera] * n)
        self.covers = vstack([covers, csr_array((1, covers.shape[1]))], format="csr")  # -1: no photograph
        present = self.surface.covering(self.patches, self.images, self.cameras)
        self.count = np.asarray(present.sum(axis=0)).reshape(-1)  # images that cover each patch
        self.to_target = csr_array(
            (
                np.full(len(self.patches.view), 1 / self.patches.n_cells),
                (np.arange(len(self.patches.view)), self.patches.view),
            ),
            shape=(len(self.patches.view), len(targets)),
        )
        self.coverage = self.patches.shares(self.count >= 2)
        self.fitted = fit_coverage(self.coverage, targets.score)
        # the same of the candidates themselves, which must register
        self.seen = self.surface.patches(self.candidates, 5, 4)
        seen = self.surface.covering(self.seen, self.images, self.cameras)
        self.seen_count = np.asarray(seen.sum(axis=0)).reshape(-1)
        self.candidate_coverage = self.seen.shares(self.seen_count >= 2)

    def _taken(self, candidates: Float) -> NDArray[np.bool_]:
        """Return which candidates nearly are mapping images: within 25 cm and 20 degrees."""
        centers = camera_centers(candidates)
        near = cKDTree(camera_centers(self.images)).query_ball_point(centers, 0.25) if len(self.images) else []
        taken = np.zeros(len(candidates), dtype=bool)
        for row, rows in enumerate(near):
            taken[row] = bool((self.images[rows, 2, :3] @ candidates[row, 2, :3] > np.cos(np.radians(20))).any())
        return taken

    @cached_property
    def scores(self) -> Float:
        """Probabilities (C,) that the candidates register in the present map."""
        return self.registration.score(self.candidates)

    @cached_property
    def _fitted_registration(self) -> tuple[float, float]:
        return fit_coverage(self.candidate_coverage, self.scores)

    def predicted(self) -> Float:
        """Return the probability (T,) that each target view localizes with the photographs so far."""
        return self._predicted(self.patches.shares(self.count >= 2))

    def _predicted(self, coverage: Float) -> Float:
        """Return the probabilities (..., T) that target views localize if these shares of them are covered."""
        return raised(self.targets.score, self.fitted, self.coverage, coverage)

    def registers(self) -> Float:
        """Return the probability (C,) that each candidate registers with the photographs so far."""
        now = self.seen.shares(self.seen_count >= 2)
        return raised(self.scores, self._fitted_registration, self.candidate_coverage, now)

    @cached_property
    def pairs(self) -> NDArray[np.int64]:
        """Rows (K, 2) of candidates 0.35 to 1.4 m apart that look less than 50 degrees apart."""
        centers = camera_centers(self.candidates)
        pairs = cKDTree(centers).query_pairs(1.4, output_type="ndarray")
        a, b = pairs.T
        apart = np.linalg.norm(centers[a] - centers[b], axis=1)
        alike = np.einsum("ki,ki->k", self.candidates[a, 2, :3], self.candidates[b, 2, :3]) > np.cos(np.radians(50))
        return pairs[(apart >= 0.35) & alike].astype(np.int64)

    def best(self, pairs: NDArray[np.int64]) -> tuple[NDArray[np.int64], float]:
        """Return the pair (2,) with the greatest gain, and the sum of probabilities that the target views gain by it.

        Gains are computed for those whose gain may be greatest when all patches of a target view count alike.
        """
        coverage = self.patches.shares(self.count >= 2)
        rise = (self._predicted(coverage + 0.25) - self._predicted(coverage)) / 0.25
        weight = rise[self.patches.view] / self.patches.n_cells
        alone = self.covers @ (weight * (self.count == 1))
        together = self.covers @ (weight * (self.count == 0))
        a, b = pairs.T
        pairs = pairs[np.argsort(-(alone[a] + alone[b] + np.minimum(together[a], together[b])), kind="stable")[:3000]]
        gains = np.concatenate([self._gains(pairs[begin : begin + 500]) for begin in range(0, len(pairs), 500)])
        return pairs[gains.argmax()], float(gains.max())

    def _gains(self, pairs: NDArray[np.int64]) -> Float:
        """Return how much the probabilities of all target views rise by each of pairs (K, 2), (K,)."""
        both = (self.covers[pairs[:, 0]] + self.covers[pairs[:, 1]]).tocsr()
        counts = self.count[both.indices]
        both.data = ((counts < 2) & (counts + both.data >= 2)).astype(np.float32)
        more = (both @ self.to_target).toarray()
        coverage = self.patches.shares(self.count >= 2)
        return (self._predicted(coverage + more) - self._predicted(coverage)).sum(axis=1)

    def add(self, row: int) -> None:
        """Add a candidate to the map."""
        self.count = self.count + self.covers[[row]].toarray()[0]
        seen = self.surface.covering(self.seen, self.candidates[[row]], [self.camera])
        self.seen_count = self.seen_count + seen.toarray()[0]

    def plan(self, n: int, least_p: float = 0.3, until: float = 1.0, seed: int = 0) -> Extension:
        """Choose up to n photographs, greedily in pairs of which one registers with at least `least_p` in the map so far.

        They end where the predicted share of target views that localize reaches `until`, or nothing is gained. Raises
        MapError if none registers, SceneError if no two of them can map a landmark.
        """
        if n > 1 and len(self.pairs) == 0:
            fix = "Check --height and the scale, widen --pitch, or take single photographs: --n 1."
            problem = "no two photographs are 0.35 to 1.4 m apart and less than 50 degrees"
            raise SceneError(problem, value=f"{len(self.candidates)} photographs", fix=fix)
        bootstrap = ClusterBootstrap(self.targets.waypoint, 1000, seed)
        ones = np.ones(len(self.targets))
        before = float(self.targets.score.mean())
        free = np.ones(len(self.candidates) + 1, dtype=bool)
        records: list[tuple[Any, ...]] = []
        rows: list[int] = []
        while len(rows) < n and before < until:
            p = np.append(self.registers(), 0.0)
            single = np.column_stack([np.arange(len(p) - 1), np.full(len(p) - 1, -1)])
            pairs = self.pairs if n - len(rows) > 1 else single
            usable = pairs[(p[pairs] >= least_p).any(axis=1) & free[pairs].all(axis=1)]
            if not rows and not (p >= least_p).any():
                raise self._nothing_registers(least_p)
            if len(usable) == 0:
                break
            pair, gain = self.best(usable)
            if gain <= 1e-6 * len(ones):
                break
            members = sorted((int(row) for row in pair if row >= 0), key=lambda row: -p[row])
            numbers = [str(len(rows) + 1 + at) for at in range(len(members))]
            partners = numbers[::-1] if len(members) > 1 else [""]
            for row, partner in zip(members, partners, strict=True):
                registers = float(self.registers()[row])
                overlaps = self._overlaps(row, rows)
                self.add(row)
                free[row] = False
                rows.append(row)
                predicted = self.predicted()
                share = float(predicted.mean())
                low, high = bootstrap.ratio_interval(predicted, ones)
                records.append((share - before, share, low, high, registers, partner, overlaps))
                before = share
        views = self._reported(rows, records)
        offset, slope = self.fitted
        expected = expit(offset + slope * self.coverage)
        correlation = np.corrcoef(expected, self.targets.score)[0, 1] if len(ones) > 1 else np.nan
        return Extension(views, self.targets, self.predicted(), self.surface.name, float(correlation))

    def _reported(self, rows: list[int], records: list[tuple[Any, ...]]) -> Views:
        """Return the chosen photographs in the map's own frame."""
        poses = self.candidates[rows]
        names = ("gain", "share", "share_low", "share_high", "p_registers", "partner", "overlaps")
        columns: dict[str, Any] = dict.fromkeys(names, ())
        for name, values in zip(names, zip(*records, strict=True), strict=False):
            columns[name] = values if isinstance(values[0], str) else np.array(values)
        columns["waypoint_id"] = tuple(str(number) for number in range(1, len(rows) + 1))
        columns["rank"] = np.ones(len(rows), dtype=np.int64)
        columns["score"] = self.scorer.score(poses)
        views = Views(poses, self.camera, self.scorer.name, waypoint=np.arange(len(rows)), **columns)
        return views.in_frame(self.scorer.localization_map.frame)

    def _warn_of_parts(self) -> None:
        """Issue a `MapWarning` if images share no landmarks with the others, directly or through others."""
        images = self.scorer.localization_map.map.images
        if images is None:
            return
        observes = observation_matrix(images)
        part = connected_components(observes @ observes.T, directed=False)[1]
        apart = np.flatnonzero(part != np.bincount(part).argmax())
        if len(apart):
            names = ", ".join(images.image_names[row] for row in apart[:3])
            text = f"{len(apart)} of {len(part)} images share no landmarks with the largest part of the map, such as {names}"
            fix = "bridge them with photographs that overlap both, or check that their poses are in one frame"
            warnings.warn(f"{self.scorer.localization_map.map.path}: {text}; {fix}", MapWarning, stacklevel=3)

    def _overlaps(self, row: int, earlier: list[int]) -> str:
        """Return the names of up to five images, the photographs before included, that show most of what a candidate does."""
        localization_map = self.scorer.localization_map
        images = localization_map.map.images
        names: list[str] = []
        shared = np.empty(0)
        if images is not None:
            visible = localization_map.landmarks_in_view(self.candidates[[row]])[0]
            shared = np.asarray(observation_matrix(images)[:, visible].sum(axis=1)) / max(len(visible), 1)
            names = list(images.image_names)
        patches = np.flatnonzero(self.seen.view == row)
        if earlier:
            new = self.surface.covering(self.seen, self.candidates[earlier], [self.camera] * len(earlier))
            shared = np.append(shared, new[:, patches].sum(axis=1) / self.seen.n_cells)
            names += [f"photograph {number}" for number in range(1, len(earlier) + 1)]
        order = np.argsort(-shared, kind="stable")[:5]
        return "; ".join(names[at] for at in order if shared[at] > 0)

    def _nothing_registers(self, least_p: float) -> MapError:
        """Return the error about a map in which no photograph registers."""
        best = int(self.scores.argmax())
        world_from_map = self.scorer.localization_map.frame.world_from_map
        at = world_from_map.inverse.apply(camera_centers(self.candidates[[best]]))[0]
        where = ", ".join(f"{value:.2f}" for value in at)
        fix = f"Photograph around ({where}), the best place, first, in steps of a few decimetres; or lower least_p."
        return MapError(
            f"no photograph registers in this map with a probability of {least_p:g}",
            path=self.scorer.localization_map.map.path,
            value=f"at most {self.scores[best]:.3f}",
            fix=fix,
        )
