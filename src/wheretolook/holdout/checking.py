"""The whole check of a map, from its blocks to what is said of them."""

from __future__ import annotations

from pathlib import Path

from wheretolook.holdout.holdout import left_out_blocks
from wheretolook.holdout.holdout_blocks import VIEWS
from wheretolook.holdout.photo_map import PhotographedMap
from wheretolook.holdout.report import CheckReport, make_report
from wheretolook.holdout.scores import Scoring, check_place, score_views
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import OcclusionModel


def check_map(
    source: PhotographedMap,
    work: Path,
    scoring: Scoring = Scoring(),
    occlusion: OcclusionModel | None = None,
    views: int = VIEWS,
    workers: int = 1,
    device: str = "cpu",
) -> CheckReport:
    """Leave blocks of a map's photographs out, localize them against the rest, score them, and compare.

    Finished blocks are kept in `work`. What hides landmarks is by default told by hidden-point removal; at most so many
    `views` of a block are localized. Raises MapError if blocks leave no map; WeightsError if weights cannot be used.
    """
    check_place(source, scoring, device)
    left_out = left_out_blocks(source, work, views, workers, device)
    method, scored = score_views(source, left_out, scoring, occlusion or HiddenPointRemoval(), device)
    return make_report(source, left_out, method, scored, scoring.also)
