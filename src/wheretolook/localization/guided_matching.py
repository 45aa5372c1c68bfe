"""Matches keypoints again under a pose hypothesis: with the landmarks that the pose projects near them.

Matching against the whole map loses keypoints of repeated structure, since Lowe's ratio test rejects a landmark that has
a twin. Where a pose predicts the landmark, the twin elsewhere is no alternative. So a correct pose gains matches, which
make it more accurate, and a wrong pose gains few.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.localization.estimation import squared_errors
from wheretolook.localization.rig import Look


def match_under(look: Look, points: Float, cam_from_world: Float, radius_px: float) -> Look:
    """Return a view with the matches of all its keypoints that agree with a pose up to a radius in pixels.

    A keypoint matches the nearest of its candidates that the pose projects within the radius; a landmark keeps its
    nearest keypoint. `points` (M, 3) m are those of the candidates.
    """
    candidates = look.candidates
    assert candidates is not None
    squared = squared_errors(look.camera, candidates.pixels, points, cam_from_world)
    order = np.flatnonzero(squared < radius_px**2)
    order = order[np.argsort(candidates.squared[order], kind="stable")]
    for values in (candidates.keypoints, candidates.landmarks):  # each keypoint once, then each landmark once
        order = order[np.sort(np.unique(values[order], return_index=True)[1])]
    return replace(look, pixels=candidates.pixels[order], rows=candidates.landmarks[order])
