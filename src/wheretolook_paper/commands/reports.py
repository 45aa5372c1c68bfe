"""Reports that this package adds to the commands of the product: entry points of the group `wheretolook.reports`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.commands.demo import OVERVIEW, Demo
from wheretolook.commands.options import open_scene
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_files import has_matches, read_table
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.evaluation.config import SCORES_MD, SCORES_PNG, VARIANTS_CSV, EvaluateConfig, results_folder
from wheretolook.evaluation.results import main_rows, read_scores
from wheretolook.figures.floor_plan import save_figure
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.looks.selection import SetScoreModel, candidate_views, score_of_set
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.weights import load_scorer, resolve_weights
from wheretolook.tracking import TrackingConfig, kept_if_not_logged
from wheretolook.utils.files import write_text
from wheretolook_paper.evaluation.label_report import label_markdown, label_summary
from wheretolook_paper.evaluation.looks import (
    LOOKS_CSV,
    LOOKS_MD,
    NUMBERS,
    STRATEGIES,
    choose_set,
    label_sets,
    log_looks,
    write_looks,
)
from wheretolook_paper.evaluation.paper_tables import write_paper_tables
from wheretolook_paper.evaluation.score_report import score_markdown
from wheretolook_paper.figures.animation import save_moving
from wheretolook_paper.figures.dollhouse import dollhouse
from wheretolook_paper.figures.labels import label_figure
from wheretolook_paper.figures.overview import (
    Overview,
    instructive_location,
    outcome_in_words,
    overview_figure,
    rendered_views,
    shares_good,
)
from wheretolook_paper.figures.paths import FRAME_MS, film_frames, methods_figure, still_figure
from wheretolook_paper.figures.scores import calibration_figure, occlusion_figure, regret_figure, score_figure
from wheretolook_paper.figures.style import scene_label
from wheretolook_paper.styles import in_table_order, method_style


def report_labels(folder: Path, views: pd.DataFrame, title: str) -> tuple[Path, ...]:
    """Write `labels.md` and `labels.png` of a dataset's `pooled_labels`; return their paths."""
    summary = label_summary(views)
    save_figure(label_figure(summary), folder / "labels.png")
    write_text(folder / "labels.md", label_markdown(summary, title))
    return folder / "labels.md", folder / "labels.png"


def report_scores(folder: Path, table: pd.DataFrame, calibration: pd.DataFrame, title: str) -> str:
    """Write `scores.md`, figures and the paper's tables of a score table and its calibration curves, if any.

    The figures are `scores.png`, `regret.png`, of curves `calibration.png`, of several occlusion models
    `occlusion.png`; those of an earlier evaluation are removed. Returns the text of `scores.md`.
    """
    table = in_table_order(table)
    text = score_markdown(table, title)
    write_text(folder / SCORES_MD, text)
    save_figure(score_figure(table), folder / SCORES_PNG)
    save_figure(regret_figure(table), folder / "regret.png")
    for name in ("calibration.png", "occlusion.png"):
        (folder / name).unlink(missing_ok=True)
    if len(calibration):
        save_figure(calibration_figure(in_table_order(calibration)), folder / "calibration.png")
    rows = table
    if (folder / VARIANTS_CSV).is_file():  # a release has the rows of all inputs of the paper's network
        others = main_rows(read_scores(folder / VARIANTS_CSV))
        rows = pd.concat([table, others[~others["method"].isin(table["method"])]], ignore_index=True)
    write_paper_tables(rows, folder)
    if table["occlusion"].nunique() > 1:
        save_figure(occlusion_figure(table), folder / "occlusion.png")
    return text


def draw_path(views: dict[str, Views], landmarks: Float, title: str, folder: Path, film: str) -> list[str]:
    """Draw the last of several methods' planned paths, and all side by side; return the names of the files.

    Args:
        views: the views along each method's path.
        landmarks: (N, 3) of the map, in the frame of the views.
        title: of the picture `path.png`.
        folder: where the files are written.
        film: suffix of a film of the path, gif or mp4; none for no film.
    """
    written = ["path.png"]
    seen = list(views.values())[-1]
    save_figure(still_figure(seen, landmarks, title), folder / "path.png")
    if len(views) > 1:
        save_figure(methods_figure(views, landmarks), folder / "methods.png")
        written.append("methods.png")
    if film != "none":
        save_moving(film_frames(seen, landmarks), FRAME_MS, folder / f"path.{film}")
        written.append(f"path.{film}")
    return written


def draw_overview(options: Demo, weights: Path) -> None:
    """Draw `<dataset>/results/overview.png`: the last scene's map, and the scores of all directions at one location.

    The location is one where the direction matters (`instructive_location`); the
    worst view is that of a camera held about level, if there is one, not of the bare ceiling. The weights are a file, or
    a folder of which the best file is taken. Raises TableError if the last scene is not labelled, WeightsError if the
    weights cannot be used.
    """
    scene = open_scene(options, Dataset.load(options.root).scenes[-1])
    table = scene.folder.read_table()
    scorer = load_scorer(scene.folder.localization_map(scene.camera, scene.device), weights)
    ids, first = np.unique(table["location_id"], return_index=True)
    locations = camera_centers(poses(table))[first]
    chosen = instructive_location(table)
    location = locations[np.searchsorted(ids, chosen)]
    candidates = table[table["location_id"] == chosen]
    cam_from_world = poses(candidates)
    scores = scorer.score(cam_from_world)
    # a camera is held level up to a pitch of 25 degrees
    level = np.abs(np.arcsin(np.clip(cam_from_world[:, 2, 2], -1, 1))) <= np.radians(25.0)
    worst_row = np.argmin(np.where(level | ~level.any(), scores, np.inf))
    shown_rows = [int(np.argmax(scores)), int(worst_row)]
    best, worst = rendered_views(scene, candidates.iloc[shown_rows], scores[shown_rows], outcome_in_words)
    directions = options.sample.axes()
    by_height = np.argsort(np.abs(locations[:, 2] - location[2]), kind="stable")
    shown = by_height[np.unique(locations[by_height, :2].round(2), axis=0, return_index=True)[1]]
    drawn = Overview(
        scene=scene_label(scene.name),
        method=method_style(scorer.name).label,
        plan=dollhouse(scene.mesh, elevation_deg=90, cut_m=float(location[2]), one_sided=False, device=scene.device),
        locations=locations[shown],
        share_good=shares_good(table)[1][shown],
        place=location,
        directions=directions,
        scores=scorer.score(poses_looking_along(np.tile(location, (len(directions), 1)), directions)),
        best=best,
        worst=worst,
    )
    save_figure(overview_figure(drawn), options.root / "results" / OVERVIEW)


def evaluate_look_sets(
    dataset: Dataset,
    evaluate: EvaluateConfig,
    tracking: TrackingConfig,
    device: str,
    numbers: Sequence[int] = NUMBERS,
    strategies: Sequence[str] = tuple(STRATEGIES),
    progress: bool = True,
) -> pd.DataFrame | None:
    """Compare view sets in a split's labelled scenes; write `looks.csv` and `looks.md` next to its scores, log a run.

    Views are scored by the first of `evaluate.weights`, or those of `resolve_weights`. Returns `look_table`, or None
    if there is no scene with one camera whose labels have the pixels of their matches (`--label.store_pixels true`).
    """
    scenes = [
        scene
        for scene in dataset.split(evaluate.split)
        if scene.stage_cache("label").stored_key is not None
        and not scene.cameras_file.is_file()
        and has_matches(scene.table, pixels=True)
    ]
    weights = evaluate.weights[0] if evaluate.weights else resolve_weights(dataset=dataset)
    if not scenes or weights is None:
        return None
    maps = [scene.localization_map(device=device) for scene in scenes]
    results = [
        compare_looks(scene, load_scorer(one, str(weights), evaluate.anywhere), numbers, strategies, progress)
        for scene, one in zip(scenes, maps, strict=True)
    ]
    sets = pd.concat(results, ignore_index=True)
    folder = results_folder(dataset, evaluate)
    table = write_looks(folder, sets, f"Looks localized together on {dataset.name}, {evaluate.split} scenes")
    params: dict[str, object] = {"dataset": dataset.name, "split": evaluate.split, "weights": weights.name}
    params |= {"numbers": numbers, "strategies": strategies}
    with kept_if_not_logged(f"the comparison of looks in {folder}"):
        log_looks(tracking, table, params, [folder / name for name in (LOOKS_CSV, LOOKS_MD)])
    return table


def compare_looks(
    scene: SceneFolder, scorer: Scorer, numbers: Sequence[int], strategies: Sequence[str], progress: bool
) -> pd.DataFrame:
    """Choose sets of views by every strategy at every labelled location of a scene, and localize them jointly.

    Returns the columns of `label_sets` for each set, with `strategy`, `expected` (its predicted score), `single_good`
    (whether the best single view localizes) and `any_good` (whether any view of the set does).

    Raises a TableError if the labels lack the pixels of their matches.
    """
    table = read_table(scene.table, pixels=True)
    cam_from_world = poses(table)
    good = is_good(table)
    scores = scorer.score(cam_from_world)
    rng = np.random.default_rng(0)
    set_score = SetScoreModel.bundled()
    sets: list[list[int]] = []
    about: list[dict[str, Any]] = []
    for _, rows in table.groupby("location_id").indices.items():
        axes = cam_from_world[rows, 2, :3]
        values = scores[rows]
        center = -cam_from_world[rows[0], :, :3].T @ cam_from_world[rows[0], :, 3]
        views, certain = (candidate_views(scorer, center, axes, values, certain) for certain in (False, True))
        for strategy in strategies:
            for n in numbers:
                if n > len(rows):
                    continue
                looks = choose_set(strategy, n, axes, values, views, certain, rng)
                chosen = np.asarray(rows)[looks]
                sets.append(chosen.tolist())
                first = bool(good[rows[int(values.argmax())]])
                expected = score_of_set(views, set_score, looks)
                about.append(
                    {"scene": scene.name, "strategy": strategy, "expected": expected, "single_good": first}
                    | {"any_good": bool(good[chosen].any())}
                )
    points = scene.localization_map().landmarks.points
    text = f"looks {scene.name}" if progress else None
    labelled = label_sets(table, sets, points, scene.camera, progress=text)
    return pd.concat([pd.DataFrame(about), labelled], axis=1).assign(good=is_good(labelled))
