"""Adapt a scorer to a scene: its labelled views, the comparison before and after, and the adapted weights."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.special import expit
from sklearn.metrics import roc_auc_score

from wheretolook.dataset.layout import SceneFolder, views_by_camera
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.evaluation.statistics import ClusterBootstrap, expected_calibration_error
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.adapted.calibration import Adapted, LocalizedViews, log_losses
from wheretolook.scorers.adapted.score import AdaptedNetwork, log_odds_of
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.set.score import for_map
from wheretolook.scorers.weights import load_scorer
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import OutOfRangeWarning
from wheretolook.utils.files import fingerprint
from wheretolook.utils.texts import markdown_table

Interval = tuple[float, float, float]  # value, lower and upper end of its 95 % interval


@dataclass(frozen=True)
class Gain:
    """Metrics before and after adaptation, and their changes with intervals over neighbourhoods or photograph blocks.

    `before` and `after` hold log_loss, auc, regret (percentage points) and calibration_error, by name.
    """

    before: dict[str, float]
    after: dict[str, float]
    log_loss_less: Interval  # decrease of the log loss
    regret_less: Interval  # decrease of regret

    @property
    def is_better(self) -> bool:
        """Whether the log loss fell by more than its interval, and regret did not rise by more than its own."""
        return self.log_loss_less[1] > 0 and not self.regret_less[2] < 0

    @property
    def is_worse(self) -> bool:
        """Whether the log loss or regret rose by more than its interval."""
        return self.log_loss_less[2] < 0 or self.regret_less[2] < 0


def compare_log_odds(
    before: Float,
    after: Float,
    good: NDArray[np.bool_],
    location: NDArray[np.integer],
    centers: Float,
    seed: int = 0,
    blocks: NDArray[np.integer] | None = None,
) -> Gain:
    """Compare two predictions of log-odds (B,) for views that localize or not.

    Args:
        before: (B,) log-odds before adaptation.
        after: (B,) log-odds after it.
        good: (B,) whether each view localizes.
        location: (B,) number of each view's location; regret is over locations with several views.
        centers: (B, 3) m, camera centres.
        seed: of the bootstrap.
        blocks: (B,) block of each held-out photograph, resampled as a whole, -1 for rendered views; None for none.
    """
    _, first, row, n_views = np.unique(location, return_index=True, return_inverse=True, return_counts=True)
    row = row.reshape(-1)
    # locations in the same square metre of floor are resampled together
    clusters = np.unique(np.floor(centers[first, :2]), axis=0, return_inverse=True)[1].reshape(-1)
    if blocks is not None:
        clusters = np.where(blocks[first] >= 0, clusters.max() + 1 + blocks[first], clusters)
    bootstrap = ClusterBootstrap(clusters, 2000, seed)
    has_choice = (n_views > 1).astype(np.float64)
    localizes_somewhere = np.bincount(row, weights=good) > 0

    def mean_with_interval(values: Float, counts: Float) -> Interval:
        low, high = bootstrap.ratio_interval(values[:, None], counts[:, None])
        return float(values.sum() / max(1e-12, counts.sum())), float(low[0]), float(high[0])

    def measure(log_odds: Float) -> tuple[dict[str, float], Float, Float]:
        """Metrics, losses (B,), and 1 at locations (L,) whose best-scored view fails although another localizes."""
        losses = log_losses(log_odds, good)
        order = np.lexsort((-log_odds, row))
        chosen = order[np.flatnonzero(np.diff(row[order], prepend=-1))]
        missed = (localizes_somewhere & ~good[chosen]) * has_choice
        auc = float(roc_auc_score(good, log_odds)) if 0 < good.sum() < len(good) else np.nan
        regret = 100 * float(missed.sum() / max(1.0, has_choice.sum()))
        error = expected_calibration_error(expit(log_odds), good)
        metrics = {"log_loss": float(losses.mean()), "auc": auc, "regret": regret, "calibration_error": error}
        return metrics, losses, missed

    metrics_before, losses_before, missed_before = measure(before)
    metrics_after, losses_after, missed_after = measure(after)
    decrease = np.bincount(row, weights=losses_before - losses_after).astype(np.float64)
    log_loss_less = mean_with_interval(decrease, n_views.astype(np.float64))
    regret_less = mean_with_interval(100 * (missed_before - missed_after), has_choice)
    return Gain(metrics_before, metrics_after, log_loss_less, regret_less)


def gain_markdown(gain: Gain) -> str:
    """Format a gain as a Markdown table and a sentence."""
    names = {"regret": "regret", "auc": "AUC", "calibration_error": "calibration error", "log_loss": "log loss"}
    rows = [[text, f"{gain.before[key]:.3f}", f"{gain.after[key]:.3f}"] for key, text in names.items()]
    summary = "Log loss decreases by {:.3f} [{:.3f}, {:.3f}]".format(*gain.log_loss_less)
    if np.isnan(gain.regret_less[1]):
        summary += "; regret is unknown, as no location has several views."
    else:
        summary += ", regret by {:+.1f} points [{:+.1f}, {:+.1f}].".format(*gain.regret_less)
    return f"{markdown_table(('', 'before', 'adapted'), rows)}\n\n{summary}\n"


def labelled_views(files: SceneFolder, scene: Scene, table: pd.DataFrame, weights: Path) -> LocalizedViews:
    """Return the labelled views of a scene with the log-odds that the weights give them."""
    cam_from_world = poses(table)
    log_odds = np.empty(len(table))
    for camera, rows in views_by_camera(files, table):
        own = scene.localization_map.of_camera(camera) if scene.map.has_photographs else None
        scorer = load_scorer(own or files.localization_map(camera, scene.device), weights)
        with warnings.catch_warnings():  # how accurate the weights are here is what is measured
            warnings.simplefilter("ignore", OutOfRangeWarning)
            log_odds[rows] = log_odds_of(scorer.score(cam_from_world[rows]))
    axes = cam_from_world[:, 2, :3]
    group = table["location_id"].to_numpy(np.int64)
    return LocalizedViews.rendered(log_odds, is_good(table), camera_centers(cam_from_world), axes, group)


def save_adapted(
    path: Path, weights: Path, whole: LocalizationMap, adapted: Adapted, about: Mapping[str, Any], gain: Gain
) -> None:
    """Write the weights of the method `set` in a file, adapted to a scene whose whole map is given, and their gain."""
    base = for_map(TrainedNetwork.load(weights, SetNetwork, "set", device=whole.device), whole)
    points = whole.landmarks.points
    # the scene is recognized by as many landmarks
    n_signature = min(256, len(points))
    error_scale = None if base.of_map is None else base.of_map.error_scale
    network = AdaptedNetwork(base.network, base.scale, base.offset, n_signature, error_scale)
    network.place[:] = torch.from_numpy(points[np.arange(n_signature) * len(points) // max(1, n_signature)])
    trained = TrainedNetwork("adapted", network, base.camera, adapted.scale, adapted.offset, base.training_range)
    about = {**about, "weights_sha256": fingerprint(weights)}
    trained.save(path, {**about, "before": gain.before, "after": gain.after})
