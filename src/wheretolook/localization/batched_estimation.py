"""Estimates the poses of many images at once, on a GPU or the CPU, as `JointLocalizer` does those of single images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

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
from wheretolook.localization.estimation import MIN_MATCHES, RIVAL_TRIALS, PoseAmbiguity, PoseEstimator, most_likely
from wheretolook.localization.estimation_kernel import p3p_kernel
from wheretolook.localization.rig import MAX_NEAREST_RATIO
from wheretolook.utils.warp import start_warp

FAR = 1e6
"""Coordinates of a missing keypoint, which is never an inlier."""


class EstimatedPose(NamedTuple):
    """A pose (3, 4), the rows of the landmarks that agree with it, and its support (`estimation.Hypothesis`)."""

    pose: Float
    rows: NDArray[np.int64]
    support: float


@dataclass(frozen=True, eq=False)
class MatchBatch:
    """Matches of V views of one camera, of all S hypotheses or of each: points (V, 1 or S, M, 3) m, keypoints (…, M, 2).

    Keypoints are on the plane at depth 1. Errors and the focal lengths (2,) are in units of RANSAC's limit.
    """

    points: Tensor
    keypoints: Tensor
    focal: Tensor

    def take(self, rows: Tensor, kept: Tensor) -> MatchBatch:
        """Return the matches in rows (V, S, R), those that are not kept as missing ones."""
        points, keypoints = (torch.take_along_dim(x, rows[..., None], 2) for x in (self.points, self.keypoints))
        return MatchBatch(points, torch.where(kept[..., None], keypoints, FAR), self.focal)

    def errors(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Errors (V, S, M, 2) of poses, infinite behind the camera, and the points (V, S, M, 3) in its frame."""
        in_camera = self.points @ poses[..., :3].mT + poses[..., None, :, 3]
        error = (in_camera[..., :2] / in_camera[..., 2:] - self.keypoints) * self.focal
        return torch.where(in_camera[..., 2:] > 1e-6, error, torch.inf), in_camera

    def evaluate(self, poses: Tensor) -> tuple[Tensor, Tensor]:
        """Return the support (V, S) of poses, and their inliers (V, S, M)."""
        squared = self.errors(poses)[0].square().sum(-1)
        return (1 - squared).clamp(min=0).sum(-1), squared < 1

    def refine(self, poses: Tensor, scale: float, steps: int = 8) -> tuple[Tensor, Tensor]:
        """Refine poses (V, S, 3, 4) on their inliers by Gauss-Newton steps with Cauchy weights.

        Returns those of least cost, and this cost (V, S).
        """
        identity = torch.eye(3, dtype=poses.dtype, device=poses.device)[None, None]
        best = poses
        least = torch.full_like(poses[..., 0, 0], torch.inf)
        for _ in range(steps):
            error, in_camera = self.errors(poses)
            squared = error.square().sum(-1)
            relative = 1 + squared.clamp(max=1) / scale**2
            cost = relative.log().sum(-1)
            best = torch.where((cost < least)[..., None, None], poses, best)
            least = torch.fmin(cost, least)
            depth = in_camera[..., 2:, None]
            slope = -in_camera[..., :2, None] * self.focal[:, None] / depth
            by_point = torch.cat([torch.diag(self.focal).expand(*slope.shape[:-1], 2), slope], -1) / depth
            jacobian = torch.cat([torch.linalg.cross(in_camera[..., None, :], by_point), by_point], -1)
            inside = (squared < 1)[..., None]
            jacobian = torch.where(inside[..., None], jacobian, 0).flatten(-3, -2)
            weighted = (jacobian / relative.repeat_interleave(2, -1)[..., None]).mT
            gradient = weighted @ torch.where(inside, error, 0).flatten(-2)[..., None]
            step = torch.linalg.solve_ex(weighted @ jacobian, gradient)[0][..., 0]
            half = torch.linalg.cross(identity, step[..., None, :3]) / 2
            poses = torch.linalg.solve_ex(identity + half, identity - half)[0] @ poses  # Cayley's rotation
            poses[..., 3] -= step[..., 3:]
        return best, least

    def pose_by_three(self, drawn: Tensor, counts: Tensor, scale: float) -> tuple[Tensor, Tensor]:
        """Return the best pose (V, 1, 3, 4) by P3P and refinement and its cost (V, 1).

        Rows `drawn` (V, T, 3) int32 are of the first `counts` (V,) int32 matches.
        """
        costs = self.points.new_full((*drawn.shape[:2], 4), torch.inf)
        turns = self.points.new_full((*costs.shape, 3, 3), torch.nan)
        shifts = turns[..., 0].contiguous()
        stream = wp.stream_from_torch(costs.device) if costs.is_cuda else None
        keypoints = pad(self.keypoints[:, 0], (0, 1), value=1.0)
        focal_x, focal_y = self.focal.tolist()
        inputs = [self.points[:, 0], keypoints, wp.vec3d(focal_x, focal_y, 0.0), counts, drawn]
        wp.launch(p3p_kernel, drawn.shape[:2], [*inputs, costs, turns, shifts], device=str(costs.device), stream=stream)
        few = costs.flatten(1).topk(16, largest=False).indices[..., None, None]
        poses = torch.cat([turns, shifts[..., None]], -1).flatten(1, 2)
        poses, costs = self.refine(torch.take_along_dim(poses, few, 1), scale, 4)
        best = costs.argmin(1)[:, None, None, None]
        return self.refine(torch.take_along_dim(poses, best, 1), scale)


class DeviceAmbiguity(PoseAmbiguity):
    """Ambiguity of a map, whose landmarks (N, 3) m are on a device."""

    def __init__(self, landmarks: Tensor) -> None:
        self.points = landmarks.cpu().numpy()
        self.landmarks = landmarks[landmarks.isfinite().all(1)].float()

    def are_near(self, points: Float, radius_m: float) -> NDArray[np.bool_]:
        """Return which points (M, 3) m have a landmark within a radius."""
        found = torch.from_numpy(points).to(self.landmarks)
        exact = "donot_use_mm_for_euclid_dist"
        rows = found.split(max(1, 2**26 // max(1, len(self.landmarks))))  # of distances, 256 MB
        nearest = [torch.cdist(part, self.landmarks, compute_mode=exact).amin(1) for part in rows]
        return (torch.cat(nearest) < radius_m).cpu().numpy()


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
        self.ambiguity = DeviceAmbiguity(self.points)

    def localize(
        self, views: Sequence[tuple[Keypoints, Matches]], camera: PinholeCamera, count: int
    ) -> list[tuple[EstimatedPose | None, EstimatedPose | None]]:
        """Estimate the first and the best of `count` hypotheses of views, from their matches sorted by quality.

        Each is found among the matches that the others do not explain. Several are matched again under their guidance.
        """
        focal = torch.tensor((camera.fx, camera.fy), dtype=torch.float64, device=self.device)
        at = [(of_view.pixels - camera.principal_point) / (camera.fx, camera.fy) for of_view, _ in views]
        keypoints = self._padded([np.nan_to_num(of_view, nan=FAR) for of_view in at])
        found_at = self._padded([found.keypoints for _, found in views])
        left = self._padded([np.ones(len(found.landmarks), bool) for _, found in views])
        rows = self._padded([found.landmarks for _, found in views])
        focal /= self.config.max_error_px
        matches = MatchBatch(self.points[rows], torch.take_along_dim(keypoints, found_at[..., None], 2), focal)
        found = []
        for n in range(count):
            pose = self._sample(matches, left, RIVAL_TRIALS if n else self.config.max_trials)
            inliers = matches.evaluate(pose)[1] & left
            enough = inliers.sum(-1, keepdim=True) >= 3  # fewer do not determine a pose
            found.append(torch.where(enough[..., None], pose, torch.nan))
            if n == 0:
                firsts = [self._best(poses) for poses in _results(matches, found[0], rows)]
            left = left & ~inliers & enough
        if count == 1:
            return [(first, first) for first in firsts]
        scale = 0.5 / self.config.max_error_px  # as by `RigMatches.refine`
        poses, _ = matches.refine(torch.cat(found, 1), scale)
        squared = self._padded([found.squared for _, found in views], torch.nan)
        number = squared.shape[-1]
        allowed = (squared <= MAX_NEAREST_RATIO**2 * squared[..., :1]).flatten(2)
        order = torch.where(allowed, squared.flatten(2), torch.inf).argsort(stable=True)
        order = order[..., : int(allowed.sum(-1).max())]
        near = self._padded([found.near for _, found in views]).flatten(2).gather(-1, order)
        seen = torch.take_along_dim(keypoints, order[..., None] // number, 2)
        candidates = MatchBatch(self.points[near], torch.where(allowed.gather(-1, order)[..., None], seen, FAR), focal)
        for radius_px in (12.0, 6.0):  # as by `RigMatches.guided`
            inside = candidates.errors(poses)[0].square().sum(-1) < (radius_px / self.config.max_error_px) ** 2
            chosen = _firsts(_firsts(inside, order // number), near)
            guided = torch.argsort((~chosen).byte(), stable=True)[..., : int(chosen.sum(-1).max())]
            matches = candidates.take(guided, chosen.gather(-1, guided))
            poses, _ = matches.refine(poses, scale)
        results = _results(matches, poses, near.expand_as(chosen).gather(-1, guided))
        return [(first, self._best(poses)) for first, poses in zip(firsts, results, strict=True)]

    def _best(self, poses: Sequence[EstimatedPose]) -> EstimatedPose | None:
        """Return the most likely pose, in the world, of poses by decreasing support."""
        if not poses:
            return None
        local = np.stack([x.pose for x in poses])
        error_m, error_deg = pose_error(local[:, None], local)
        differs = (error_m > 0.5) | (error_deg > 10)  # as by `Hypothesis.differs_from`
        strong: list[int] = []  # others are not chosen
        for k, pose in enumerate(poses):
            if pose.support >= 0.1 * poses[0].support and differs[k, strong].all():
                strong.append(k)
        unique = self.ambiguity.unique_supports([poses[k].rows for k in strong], local[strong])
        best = poses[strong[most_likely(unique, [poses[k].support for k in strong])]]
        return best._replace(pose=poses_from(best.pose, -self.origin))

    def _padded(self, values: Sequence[NDArray[Any]], padding: float = 0) -> Tensor:
        """Copy values (M_v, ...) of V views to the device, as (V, 1, M, ...)."""
        return pad_sequence([torch.from_numpy(x) for x in values], True, padding)[:, None].to(self.device)

    def _sample(self, matches: MatchBatch, left: Tensor, max_trials: int) -> Tensor:
        """Estimate a pose (V, 1, 3, 4) of each view by RANSAC among the matches that are left (V, 1, M); NaN for none."""
        order = torch.argsort((~left).byte(), stable=True)
        matches = matches.take(order, left.gather(-1, order))
        counts = left.sum((1, 2))
        best = self.points.new_full((len(left), 1, 3, 4), torch.nan)
        costs = torch.full_like(best[..., 0, 0], torch.inf)
        rng = np.random.default_rng(self.config.seed)
        trials = 1000  # of a round
        views = torch.nonzero(counts >= MIN_MATCHES)[:, 0]
        for trial in range(0, max_trials, trials):
            if len(views) == 0:
                break
            share = np.minimum(np.arange(trial + 1, trial + trials + 1) / trials, 1) ** (1 / 3)
            draws = torch.from_numpy(np.vstack([share, rng.random((3, trials))])).to(self.device)
            number = counts[views, None].double()
            pool = (number * draws[0]).ceil().clamp(min=3)
            first = (pool * draws[1]).floor()
            second = (first + 1 + ((pool - 1) * draws[2]).floor()) % pool
            third = ((pool - 2) * draws[3]).floor()
            third += third >= torch.minimum(first, second)
            third += third >= torch.maximum(first, second)
            drawn = torch.stack([first, second, third], -1).int()
            some = MatchBatch(matches.points[views], matches.keypoints[views], matches.focal)
            pose, cost = some.pose_by_three(drawn, counts[views].int(), 1 / self.config.max_error_px)
            best[views] = torch.where((cost < costs[views])[..., None, None], pose, best[views])
            costs[views] = torch.minimum(cost, costs[views])
            ratio = some.evaluate(best[views])[1].sum((1, 2)) / number[:, 0]
            views = views[torch.log1p(-(ratio**3)) * (trial + trials) > math.log(1 - self.config.confidence)]
        return best


def _firsts(kept: Tensor, group: Tensor) -> Tensor:
    """Keep of those that are kept (V, S, M) the first of each group (V, 1, M)."""
    group = torch.unique(group, return_inverse=True)[1].expand_as(kept)
    number = kept.shape[-1]
    place = torch.where(kept, torch.arange(number, device=kept.device), number)
    first = place.new_full((*kept.shape[:2], int(group.max()) + 1), number).scatter_reduce(-1, group, place, "amin")
    return kept & (first.gather(-1, group) == place)


def _results(matches: MatchBatch, poses: Tensor, rows: Tensor) -> list[list[EstimatedPose]]:
    """Return the poses of each view by decreasing support, without missing ones."""
    support, inliers = matches.evaluate(poses)
    arrays = [x.cpu().numpy() for x in (poses, inliers, rows.expand_as(inliers), support)]
    results = []
    for of_view in zip(*arrays, strict=True):
        found = [
            EstimatedPose(pose, row[mask], value) for pose, mask, row, value in zip(*of_view, strict=True) if value
        ]
        results.append(sorted(found, key=lambda pose: -pose.support))
    return results
