"""What this package adds to `wheretolook evaluate`: the paper's tables, a figure of occlusion models, sets of looks."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_files import has_matches, read_table
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.tracking.store import kept_if_not_logged
from wheretolook_paper.evaluation.looks import LOOKS_CSV, LOOKS_MD, NUMBERS, STRATEGIES, log_looks, write_looks

if TYPE_CHECKING:
    from wheretolook.evaluation.config import EvaluateConfig
    from wheretolook.scorers.base import Scorer
    from wheretolook.tracking.store import TrackingConfig


def write_reports(folder: Path, table: pd.DataFrame) -> None:
    """Write the paper's tables and, of several occlusion models, `occlusion.png`, from a table of scores."""
    from wheretolook.evaluation.results import OCCLUSION_PNG, VARIANTS_CSV, main_rows, read_scores
    from wheretolook.figures.style import save_figure
    from wheretolook_paper.evaluation.paper_tables import write_paper_tables
    from wheretolook_paper.figures.occlusion import occlusion_figure

    rows = table
    if (folder / VARIANTS_CSV).is_file():  # a release has the rows of all inputs of the paper's network
        others = main_rows(read_scores(folder / VARIANTS_CSV))
        rows = pd.concat([table, others[~others["method"].isin(table["method"])]], ignore_index=True)
    write_paper_tables(rows, folder)
    (folder / OCCLUSION_PNG).unlink(missing_ok=True)
    if table["occlusion"].nunique() > 1:
        save_figure(occlusion_figure(table), folder / OCCLUSION_PNG)


@dataclass(frozen=True)
class LookConfig:
    """Compared numbers of views and strategies, noise of the rotations between views, and the seed."""

    numbers: tuple[int, ...] = NUMBERS
    strategies: tuple[str, ...] = tuple(STRATEGIES)
    turn_noise_deg: float = 0.0
    seed: int = 0


def evaluate_look_sets(
    dataset: Dataset,
    evaluate: EvaluateConfig,
    tracking: TrackingConfig,
    device: str,
    config: LookConfig = LookConfig(),
    progress: bool = True,
) -> pd.DataFrame | None:
    """Compare view sets in a split's labelled scenes; write `looks.csv` and `looks.md` next to its scores, log a run.

    Views are scored by the first of `evaluate.weights`, or those of `resolve_weights`. Returns `look_table`, or None
    if there is no scene with one camera whose labels have the pixels of their matches (`--label.store_pixels true`).
    """
    from wheretolook.evaluation.results import results_folder
    from wheretolook.scorers.weights import load_scorer, resolve_weights

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
        compare_looks(scene, load_scorer(str(weights), one, evaluate.anywhere), config, progress)
        for scene, one in zip(scenes, maps, strict=True)
    ]
    sets = pd.concat(results, ignore_index=True)
    folder = results_folder(dataset, evaluate)
    table = write_looks(folder, sets, f"Looks localized together on {dataset.name}, {evaluate.split} scenes")
    params = {"dataset": dataset.name, "split": evaluate.split, "weights": weights.name, **asdict(config)}
    with kept_if_not_logged(f"the comparison of looks in {folder}"):
        log_looks(tracking, table, params, [folder / name for name in (LOOKS_CSV, LOOKS_MD)])
    return table


def compare_looks(scene: SceneFolder, scorer: Scorer, config: LookConfig, progress: bool) -> pd.DataFrame:
    """Choose sets of views by every strategy at every labelled location of a scene, and localize them jointly.

    Returns the columns of `label_sets` for each set, with `strategy`, `expected` (its predicted score), `single_good`
    (whether the best single view localizes) and `any_good` (whether any view of the set does).

    Raises a TableError if the labels lack the pixels of their matches.
    """
    from wheretolook.looks.selection import SetScoreModel, candidate_views, score_of_set
    from wheretolook_paper.evaluation.joint_labels import label_sets
    from wheretolook_paper.evaluation.look_strategies import choose_set

    table = read_table(scene.table, pixels=True)
    cam_from_world = poses(table)
    good = is_good(table)
    scores = scorer.score(cam_from_world)
    rng = np.random.default_rng(config.seed)
    set_score = SetScoreModel.bundled()
    sets: list[list[int]] = []
    about: list[dict[str, Any]] = []
    for _, rows in table.groupby("location_id").indices.items():
        axes = cam_from_world[rows, 2, :3]
        values = scores[rows]
        center = -cam_from_world[rows[0], :, :3].T @ cam_from_world[rows[0], :, 3]
        views, certain = (candidate_views(scorer, center, axes, values, certain) for certain in (False, True))
        for strategy in config.strategies:
            for n in config.numbers:
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
    labelled = label_sets(
        table, sets, points, scene.camera, turn_noise_deg=config.turn_noise_deg, seed=config.seed, progress=text
    )
    return pd.concat([pd.DataFrame(about), labelled], axis=1).assign(good=is_good(labelled))
