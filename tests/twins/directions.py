"""The plain version of scoring all directions: views one by one, from the same landmarks."""

import numpy as np

from wheretolook.geometry.poses import poses_looking_along
from wheretolook.scorers.set.accuracy import probabilities
from wheretolook.visibility.frustum import LandmarkSets
from wheretolook.visibility.occlusion import DevicePoints


def score_directions(scorer, locations, directions, limit):
    """`BatchedDirections.score`."""
    localization_map = scorer.localization_map
    poses = poses_looking_along(np.repeat(locations, len(directions), axis=0), np.tile(directions, (len(locations), 1)))
    place = np.argsort(DevicePoints(localization_map.landmarks.points).order)
    seen = localization_map.landmarks_in_view(poses)
    n_visible = np.diff(seen.starts)
    strides = 2 ** np.ceil(np.log2(np.maximum(n_visible, 1) / limit)).clip(0).astype(int)
    kept = [seen[row][place[seen[row]] % stride == 0] for row, stride in enumerate(strides)]
    starts = np.concatenate([[0], np.cumsum([len(rows) for rows in kept])]).astype(np.int32)
    described = scorer.describer.describe(poses, LandmarkSets(starts, np.concatenate(kept)))
    sums = scorer.network.sums_of(described, described.counts.new_tensor(n_visible))
    return probabilities(scorer.trained, scorer.accuracy, sums).reshape(len(locations), -1), strides
