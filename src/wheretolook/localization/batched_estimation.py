"""Estimates the poses of many images at once, on a GPU or the CPU, as `JointLocalizer` does those of single images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad
from torch.nn.utils.rnn import pad_sequence

from wheretolook.features.extractor import Keypoints
from wheretolook.features.matches import Matches
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.geometry.similarity import poses_from
from wheretolook.localization.estimation import MIN_MATCHES, PoseEstimator, preferences
from wheretolook.localization.estimation_kernel import p3p_kernel, refine_kernel, unexplained_kernel
from wheretolook.localization.rig import MAX_NEAREST_RATIO
from wheretolook.utils.warp import start_warp

FAR = 1e6
"""Coordinates of a missing keypoint, which is never an inlier."""

TRIALS = 1000
"""RANSAC trials of a round, after which a view may be finished."""


EstimatedPose = tuple[Float, NDArray[np.int64]]
"""A pose (3, 4), and the rows of the landmarks that agree with it."""


@dataclass(frozen=True, eq=False)
class MatchBatch:
    """Matches of V views of one camera, of all S hypotheses or of each: points (V, 1 or S, M, 3) m, keypoints (…, M, 2).

    Keypoints are on the plane at depth 1. Errors and the focal lengths are in units of RANSAC's limit.
    """

    points: Tensor
    keypoints: Tensor
    focal: tuple[float, float]

    def take(self, rows: Tensor, kept: Tensor) -> MatchBatch:
        """Return the matches in rows (V, S, R), those that are not kept as missing ones."""
        points, keypoints = (torch.take_along_dim(x, rows[..., None], 2) for x in (self.points, self.keypoints))
        return MatchBatch(points, torch.where(kept[..., None], keypoints, FAR), self.focal)

    def squared_errors(self, poses: Tensor) -> Tensor:
        """Squared errors (V, S, M) of poses, infinite behind the camera."""
        x, y, z = (self.points @ poses[..., :3].mT + poses[..., None, :, 3]).unbind(-1)
        at_x, at_y = self.keypoints.unbind(-1)
        error_x, error_y = (x / z - at_x) * self.focal[0], (y / z - at_y) * self.focal[1]
        return torch.where(z > 1e-6, error_x**2 + error_y**2, torch.inf)

    def evaluate(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Return the support (V, S) of poses, and their inliers (V, S, M)."""
        squared = self.squared_errors(poses)
        return (1 - squared).clamp(min=0).sum(-1), squared < 1

    def refine(self, poses: Tensor, scale: float, steps: int = 8) -> tuple[Tensor, Tensor]:
        """Refine poses (V, S, 3, 4) on their inliers by Gauss-Newton steps with Cauchy weights.

        Returns those of least cost, and this cost (V, S).
        """
        poses = poses.clone()
        costs = torch.full_like(poses[..., 0, 0], torch.inf)
        inputs = [self.points, self.keypoints, wp.vec2d(*self.focal), scale, steps, poses, costs]
        wp.launch_tiled(refine_kernel, dim=costs.shape, inputs=inputs, **launch_options(costs))
        return poses, costs

    def pose_by_three(self, drawn: Tensor, counts: Tensor, scale: float) -> tuple[Tensor, Tensor]:
        """Return the best pose (V, 1, 3, 4) by P3P and refinement and its cost (V, 1).

        Rows `drawn` (V, T, 3) int32 are of the first `counts` (V,) int32 matches.
        """
        costs = self.points.new_full((*drawn.shape[:2], 4), torch.inf)
        turns = self.points.new_full((*costs.shape, 3, 3), torch.nan)
        shifts = turns[..., 0].contiguous()
        keypoints = pad(self.keypoints[:, 0], (0, 1), value=1.0)
        inputs = [self.points[:, 0], keypoints, wp.vec3d(*self.focal, 0.0), counts, drawn]
        wp.launch(p3p_kernel, drawn.shape[:2], [*inputs, costs, turns, shifts], **launch_options(costs))
        few = costs.flatten(1).topk(16, largest=False).indices[..., None, None]
        columns = (torch.take_along_dim(x.flatten(1, 2), few, 1) for x in (turns, shifts[..., None]))
        poses, costs = self.refine(torch.cat([*columns], -1), scale, 4)
        best = costs.argmin(1)[:, None, None, None]
        return self.refine(torch.take_along_dim(poses, best, 1), scale)


def launch_options(values: Tensor) -> dict[str, Any]:
    """Return the options of a launch of a Warp kernel, in the order of PyTorch's work on the device of values."""
    stream = wp.stream_from_torch(values.device) if values.is_cuda else None
    return {"device": str(values.device), "stream": stream, "block_dim": 64}


class BatchedEstimator:
    """Estimates poses of images of one pinhole camera on a device, as `JointLocalizer` does those of single images.

    Matches are drawn in the order of their quality (PROSAC, Chum and Matas, CVPR 2005). The best poses of P3P by squared
    errors of all matches (MSAC) are refined. The reference is PoseLib, which is faster on a CPU. A result does not
    depend on the other images.
    """

    def __init__(self, estimator: PoseEstimator, device: str) -> None:
        self.config = estimator.config
        self.origin = estimator.origin
        self.device = start_warp(device)
        self.points = torch.from_numpy(estimator.points).to(self.device)
        self.voxels = torch.unique((self.points / 0.25).floor(), dim=0, return_inverse=True)[1]  # `PoseAmbiguity`
        self.landmarks = wp.from_torch(self.points[self.points.isfinite().all(1)].float(), dtype=wp.vec3)
        self.grid = wp.HashGrid(128, 128, 128, self.device)  # cells, which repeat
        if self.points.is_cuda:
            torch.cuda.synchronize(self.device)
        self.grid.build(self.landmarks, 0.4)
        wp.synchronize_device(self.device)
        rounds = self.config.max_trials // TRIALS
        share = np.minimum(np.arange(1, rounds * TRIALS + 1) / TRIALS, 1) ** (1 / 3)
        drawn = np.random.default_rng(self.config.seed).random((rounds, 3, TRIALS))
        self.draws = torch.from_numpy(np.hstack([share.reshape(rounds, 1, TRIALS), drawn])).to(self.device)

    def localize(
        self, views: Sequence[tuple[Keypoints, Matches]], camera: PinholeCamera, count: int
    ) -> list[tuple[EstimatedPose | None, EstimatedPose | None]]:
        """Estimate the first and the best of `count` hypotheses of views, from their matches sorted by quality.

        Each is found among the matches that the others do not explain. Several are matched again under their guidance.
        """
        limit = self.config.max_error_px
        focal = camera.fx / limit, camera.fy / limit
        at = [(of_view.pixels - camera.principal_point) / (camera.fx, camera.fy) for of_view, _ in views]
        keypoints = self._padded([np.nan_to_num(of_view, nan=FAR) for of_view in at])
        found_at = self._padded([found.keypoints for _, found in views])
        left = self._padded([np.ones(len(found.landmarks), bool) for _, found in views])
        rows = self._padded([found.landmarks for _, found in views])
        seen = torch.take_along_dim(keypoints, found_at[..., None], 2)
        matches = MatchBatch(self.points[rows], torch.where(left[..., None], seen, FAR), focal)
        found = []
        for n in range(count):
            pose = self._sample(matches, left, 1 if n else len(self.draws))
            inliers = matches.evaluate(pose)[1] & left
            enough = inliers.sum(-1, keepdim=True) >= 3  # fewer do not determine a pose
            found.append(torch.where(enough[..., None], pose, torch.nan))
            left = left & ~inliers & enough
        firsts = self._best(matches, found[0], rows)
        if count == 1:
            return [(first, first) for first in firsts]
        scale = 0.5 / limit  # as by `RigMatches.refine`
        poses, _ = matches.refine(torch.cat(found, 1), scale)
        squared = self._padded([found.squared for _, found in views], torch.nan)
        number = squared.shape[-1]
        allowed = (squared <= MAX_NEAREST_RATIO**2 * squared[..., :1]).flatten(2)
        order = torch.where(allowed, squared.flatten(2), torch.inf).argsort(stable=True)
        order = order[..., : int(allowed.sum(-1).max())]
        near = self._padded([found.near for _, found in views]).flatten(2).gather(-1, order)
        near = near.clamp(max=len(self.points) - 1)  # few landmarks leave rows without one
        seen = torch.take_along_dim(keypoints, order[..., None] // number, 2)
        candidates = MatchBatch(self.points[near], torch.where(allowed.gather(-1, order)[..., None], seen, FAR), focal)
        groups = [torch.unique(x, return_inverse=True) for x in (order // number, near)]
        for radius_px in (12.0, 6.0):  # as by `RigMatches.guided`
            chosen = candidates.squared_errors(poses) < (radius_px / limit) ** 2
            for values, group in groups:
                chosen = _firsts(chosen, group, len(values))
            guided = torch.argsort((~chosen).byte(), stable=True)[..., : int(chosen.sum(-1).max())]
            matches = candidates.take(guided, chosen.gather(-1, guided))
            poses, _ = matches.refine(poses, scale)
        rows = near.expand_as(chosen).gather(-1, guided)
        return list(zip(firsts, self._best(matches, poses, rows), strict=True))

    def _best(self, matches: MatchBatch, poses: Tensor, rows: Tensor) -> list[EstimatedPose | None]:
        """Return the most likely pose of each view, in the world; None where no pose has support.

        Matches are with the landmarks in rows (V, 1 or S, M).
        """
        values = matches.evaluate(poses)
        unique_supports = self._unique_supports(matches, poses, rows, values[1])
        on_device = (*values, rows.expand_as(values[1]), poses, unique_supports)
        support, inliers, landmarks, local, unique = (x.cpu().numpy() for x in on_device)
        order = np.argsort(-support, kind="stable")
        sorted_support = np.take_along_axis(support, order, 1)
        unique = np.take_along_axis(np.take_along_axis(unique, order[..., None], 1), order[:, None], 2)
        ranked = np.take_along_axis(local, order[..., None, None], 1)
        error_m, error_deg = pose_error(ranked[:, :, None], ranked[:, None])
        differs = (error_m > 0.5) | (error_deg > 10)  # as by `Hypothesis.differs_from`
        strong = (sorted_support > 0) & (sorted_support >= 0.1 * sorted_support[:, :1])  # others are not chosen
        for k in range(1, strong.shape[1]):
            strong[:, k] &= (differs[:, k, :k] | ~strong[:, :k]).all(1)
        preference = preferences(unique, sorted_support)
        preference[:, np.eye(len(strong.T), dtype=bool)] = np.inf
        preference = np.where(strong[:, None], preference, np.inf).min(2)  # against the strongest rival
        best = order[np.arange(len(order)), np.where(strong, preference, -np.inf).argmax(1)]
        in_world = poses_from(local, -self.origin)
        return [
            (in_world[n, k], landmarks[n, k, inliers[n, k]]) if support[n, k] else None
            for n, k in enumerate(best.tolist())
        ]

    def _unique_supports(self, matches: MatchBatch, poses: Tensor, rows: Tensor, inliers: Tensor) -> Tensor:
        """Count (V, S, S) as `PoseAmbiguity.unique_supports`."""
        alone = torch.zeros((*poses.shape[:2], *inliers.shape[1:]), dtype=torch.bool, device=self.device)
        inputs = [self.grid.id, self.landmarks, 0.4, matches.points, inliers, poses, alone]
        wp.launch(unexplained_kernel, alone.shape, inputs, **launch_options(alone))
        voxels = torch.where(alone, self.voxels[rows][:, :, None], -1).sort(-1).values
        return (voxels.diff(dim=-1, prepend=voxels.new_full((*voxels.shape[:3], 1), -1)) > 0).sum(-1)

    def _padded(self, values: Sequence[NDArray[Any]], padding: float = 0) -> Tensor:
        """Copy values (M_v, ...) of V views to the device, as (V, 1, M, ...)."""
        return pad_sequence([torch.from_numpy(x) for x in values], True, padding)[:, None].to(self.device)

    def _sample(self, matches: MatchBatch, left: Tensor, rounds: int) -> Tensor:
        """Estimate a pose (V, 1, 3, 4) of each view by RANSAC among the matches that are left (V, 1, M); NaN for none."""
        order = torch.argsort((~left).byte(), stable=True)
        matches = matches.take(order, left.gather(-1, order))
        counts = left.sum((1, 2))
        number = counts[:, None].double()
        best = self.points.new_full((len(left), 1, 3, 4), torch.nan)
        costs = torch.full_like(best[..., 0, 0], torch.inf)
        unfinished = counts >= MIN_MATCHES
        for trial in range(rounds):  # on all views, so that the CPU does not wait for the GPU
            draws = self.draws[trial]
            pool = (number * draws[0]).ceil().clamp(min=3)
            first = (pool * draws[1]).floor()
            second = (first + 1 + ((pool - 1) * draws[2]).floor()) % pool
            third = ((pool - 2) * draws[3]).floor()
            third += third >= torch.minimum(first, second)
            third += third >= torch.maximum(first, second)
            drawn = torch.stack([first, second, third], -1).int()
            used = torch.where(unfinished, counts, 0).int()
            pose, cost = matches.pose_by_three(drawn, used, 1 / self.config.max_error_px)
            best = torch.where((cost < costs)[..., None, None], pose, best)
            costs = torch.minimum(cost, costs)
            ratio = matches.evaluate(best)[1].sum((1, 2)) / number[:, 0]
            limit = math.log(1 - self.config.confidence)
            unfinished &= torch.log1p(-(ratio**3)) * (trial + 1) * TRIALS > limit
        return best


def _firsts(kept: Tensor, group: Tensor, n_groups: int) -> Tensor:
    """Keep of those that are kept (V, S, M) the first of each group (V, 1, M)."""
    number = kept.shape[-1]
    place = torch.where(kept, torch.arange(number, device=kept.device), number)
    first = place.new_full((*kept.shape[:2], n_groups), number)
    first = first.scatter_reduce(-1, group.expand_as(kept), place, "amin")
    return kept & (first.gather(-1, group.expand_as(kept)) == place)
