"""Sets of looks compared: chosen together, one by one, spread evenly, and so on; joined from stored matches."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.utils.files import write_text
from wheretolook.utils.tracking_layout import BEST_TAG
from wheretolook.utils.tracking_store import kept_if_not_logged
from wheretolook.viewpoints.table import has_matches, is_good, poses, read_table

if TYPE_CHECKING:
    from wheretolook.evaluation.config import EvaluateConfig
    from wheretolook.methods.base import Scorer
    from wheretolook.utils.tracking_config import TrackingConfig

LOOKS_CSV, LOOKS_MD = "looks.csv", "looks.md"

NUMBERS = (1, 2, 3, 5)
"""Looks of a set that are compared."""

STRATEGIES = {
    "together": "chosen together, by what they see together",
    "in-turn": "one added after another, by what is seen with those before; none is exchanged",
    "one-by-one": "the best alone, at least 40° apart",
    "even": "spread evenly, from the best alone on",
    "visible": "the most different landmarks in view",
    "fisher": "exact Fisher information of the rig (log det)",
    "random": "drawn at random",
}


@dataclass(frozen=True)
class LookConfig:
    """What is compared: numbers of looks, strategies, how well turns are known, and the seed of what is drawn."""

    numbers: tuple[int, ...] = NUMBERS
    strategies: tuple[str, ...] = tuple(STRATEGIES)
    turn_noise_deg: float = 0.0
    seed: int = 0


def scenes_with_pixels(dataset: Dataset, split: str) -> list[SceneFolder]:
    """Scenes of a split, looked at by one camera, whose labels keep where landmarks were matched."""
    scenes = [scene for scene in dataset.scenes if scene.split == split and not scene.cameras_file.is_file()]
    return [scene for scene in scenes if has_matches(scene.table, pixels=True)]


def evaluate_looks(
    dataset: Dataset,
    evaluate: EvaluateConfig,
    tracking: TrackingConfig,
    config: LookConfig = LookConfig(),
    progress: bool = True,
    device: str = "cpu",
) -> pd.DataFrame | None:
    """`look_table` of a split's scenes, `looks.csv` and `looks.md` beside its scores, and an MLflow run.

    Views are scored by the first of `evaluate.weights`, or those that `planning.scene_map.default_weights` finds. None
    if no scene's labels keep where landmarks were matched (`--label.store_pixels true`).
    """
    from wheretolook.evaluation.results import results_folder
    from wheretolook.methods.registry import load_scorer
    from wheretolook.planning.scene_map import default_weights
    from wheretolook.utils.tracking import NestedRun, log, log_nested, start_run

    scenes = scenes_with_pixels(dataset, evaluate.split)
    weights = evaluate.weights[0] if evaluate.weights else default_weights(dataset)
    if not scenes or weights is None:
        return None
    maps = [scene.localization_map(device=device) for scene in scenes]
    found = [
        compare_looks(scene, load_scorer(str(weights), around, evaluate.anywhere), config, progress)
        for scene, around in zip(scenes, maps, strict=True)
    ]
    sets = pd.concat(found, ignore_index=True)
    folder = results_folder(dataset, evaluate)
    table = write_looks(folder, sets, f"Looks localized together on {dataset.name}, {evaluate.split} scenes")
    params = {"dataset": dataset.name, "split": evaluate.split, "weights": weights.name, **asdict(config)}
    numbers = ("good", "gain", "any_good", "sure", "sure_right")
    best = table[table["n_looks"] == table["n_looks"].max()].nlargest(1, "good").iloc[0]
    opened = start_run(
        tracking, "all sets", "looks", params, tags={"dataset": dataset.name, BEST_TAG: best["strategy"]}
    )
    with kept_if_not_logged(f"the comparison of looks in {folder}"), opened as (client, run):
        log(client, run, metrics={name: float(best[name]) for name in numbers})
        for name in (LOOKS_CSV, LOOKS_MD):
            client.log_artifact(run, str(folder / name))
        runs = (
            NestedRun(
                f"{row['strategy']}, {row['n_looks']} looks",
                {**params, "strategy": row["strategy"], "n_looks": row["n_looks"]},
                {name: float(row[name]) for name in numbers},
            )
            for row in table.to_dict("records")
        )
        log_nested(tracking, run, "looks", runs)
    return table


def compare_looks(
    scene: SceneFolder, scorer: Scorer, config: LookConfig = LookConfig(), progress: bool = True
) -> pd.DataFrame:
    """Sets of looks by every strategy at every labelled location of a scene, and how they were localized.

    Returns `labelling.look_sets.SET_COLUMNS` for each set, with `strategy`, `expected` (the worth it was given before),
    `single_good` (whether the look that is best alone localizes alone) and `any_good` (whether one of the looks does).

    Raises a TableError if the labels do not keep where landmarks were matched.
    """
    from wheretolook.labelling.look_sets import label_sets
    from wheretolook.looks.choice import worth_of
    from wheretolook.looks.union import seen_around
    from wheretolook.looks.worth import SetWorth

    table = read_table(scene.table, pixels=True)
    cam_from_world, good = poses(table), is_good(table)
    scores, rng = scorer.score(cam_from_world), np.random.default_rng(config.seed)
    worth = SetWorth.shipped()
    sets: list[list[int]] = []
    about: list[dict[str, Any]] = []
    for _, rows in table.groupby("location_id").indices.items():
        axes, values = cam_from_world[rows, 2, :3], scores[rows]
        center = -cam_from_world[rows[0], :, :3].T @ cam_from_world[rows[0], :, 3]
        seen, sure = (seen_around(scorer, center, axes, values, sure) for sure in (False, True))
        for strategy in config.strategies:
            for n in config.numbers:
                if n > len(rows):
                    continue
                looks = _looks(strategy, n, axes, values, seen, sure, rng)
                chosen = np.asarray(rows)[looks]
                sets.append(chosen.tolist())
                first = bool(good[rows[int(values.argmax())]])
                expected = worth_of(seen, worth, looks)
                about.append(
                    {"scene": scene.name, "strategy": strategy, "expected": expected, "single_good": first}
                    | {"any_good": bool(good[chosen].any())}
                )
    points, cameras = scene.localization_map().landmarks.points, scene.cameras()
    camera = cameras if len(cameras) > 1 else next(iter(cameras.values()))
    text = f"looks {scene.name}" if progress else None
    labelled = label_sets(
        table, sets, points, camera, turn_noise_deg=config.turn_noise_deg, seed=config.seed, progress=text
    )
    return pd.concat([pd.DataFrame(about), labelled], axis=1).assign(good=is_good(labelled))


def _looks(strategy: str, n: int, axes: Any, scores: Any, seen: Any, sure: Any, rng: np.random.Generator) -> list[int]:
    from wheretolook.looks.choice import Turns, best_one_by_one, choose_looks, evenly_spread
    from wheretolook.looks.worth import SetWorth, count_worth, fisher_worth

    if strategy == "random":
        return [int(row) for row in rng.choice(len(axes), n, replace=False)]
    if strategy == "one-by-one":
        return best_one_by_one(scores, axes, n)
    if strategy == "even":
        return evenly_spread(axes, n, int(np.argmax(scores)))
    turns = Turns(axes)
    if strategy == "visible":
        return list(choose_looks(sure, count_worth, n, turns).looks)
    if strategy == "fisher":
        return list(choose_looks(sure, fisher_worth, n, turns).looks)
    exchanges = 0 if strategy == "in-turn" else None
    return list(choose_looks(seen, SetWorth.shipped(), n, turns, first=scores, exchanges=exchanges).looks)


def look_table(sets: pd.DataFrame, resamples: int = 2000, seed: int = 0) -> pd.DataFrame:
    """Shares of locations whose looks localize together, by strategy and number of looks.

    Columns: `good` and its 95 % interval by resampling locations; `gain` over the single best look of the same places,
    paired, and its interval; `any_good`; `sure` (the share of poses called sure at 99 %) and `sure_right` (how many of
    these are right).
    """
    rng = np.random.default_rng(seed)
    rows = []
    for (strategy, n), part in sets.groupby(["strategy", "n_looks"], sort=False):
        good, gain = part["good"].to_numpy(float), (part["good"].astype(float) - part["single_good"]).to_numpy()
        drawn = rng.integers(0, len(part), (resamples, len(part)))
        low, high = np.quantile(good[drawn].mean(1), (0.025, 0.975))
        gain_low, gain_high = np.quantile(gain[drawn].mean(1), (0.025, 0.975))
        sure = part["confidence"] >= 0.99
        rows.append(
            {"strategy": strategy, "n_looks": n, "n_locations": len(part), "good": good.mean()}
            | {"good_low": low, "good_high": high, "gain": gain.mean(), "gain_low": gain_low, "gain_high": gain_high}
            | {"any_good": part["any_good"].mean(), "sure": sure.mean()}
            | {"sure_right": part.loc[sure, "good"].mean() if sure.any() else np.nan}
        )
    return pd.DataFrame(rows)


def stopping_table(sets: pd.DataFrame, asked: Sequence[float] = (0.5, 0.8, 0.9, 0.95, 0.99)) -> pd.DataFrame:
    """How many looks are needed if the camera looks on only while the confidence is below what is asked.

    Of sets whose looks are added one after another ("in-turn", of every number that was compared). Columns: `asked`,
    `looks` (mean), `good` (share of locations), `of_most` (of what the greatest number gives).
    """
    wanted = sets[sets["strategy"] == "in-turn"].sort_values("n_looks", kind="stable")
    ends: list[dict[str, float]] = []
    places = [part for _, part in wanted.groupby(["scene", "location_id"])]
    most = np.mean([part["good"].iloc[-1] for part in places]) if places else np.nan
    for limit in asked:
        stops = [int(np.argmax(np.append(part["confidence"].to_numpy()[:-1] >= limit, True))) for part in places]
        looks = [part["n_looks"].iloc[stop] for part, stop in zip(places, stops, strict=True)]
        good = np.mean([part["good"].iloc[stop] for part, stop in zip(places, stops, strict=True)])
        ends.append(
            {"asked": limit, "looks": float(np.mean(looks)), "good": float(good), "of_most": float(good / most)}
        )
    return pd.DataFrame(ends)


def write_looks(folder: Path, sets: pd.DataFrame, title: str) -> pd.DataFrame:
    """Write `looks.csv` and `looks.md` of compared sets; returns `look_table`."""
    from wheretolook.utils.markdown import markdown_table

    table, stopping = look_table(sets), stopping_table(sets)
    write_text(folder / LOOKS_CSV, table.to_csv(index=False))
    shares = [
        [row.strategy, str(row.n_looks), str(row.n_locations), _share(row.good, row.good_low, row.good_high),
         _share(row.gain, row.gain_low, row.gain_high), f"{100 * row.any_good:.1f}", f"{100 * row.sure:.1f}",
         "" if np.isnan(row.sure_right) else f"{100 * row.sure_right:.1f}"]
        for row in cast("Iterable[Any]", table.itertuples())
    ]  # fmt: skip
    head = ["looks", "N", "places", "localized together", "over one look", "any alone", "sure", "of these right"]
    stops = [
        [f"{r.asked:.2f}", f"{r.looks:.2f}", f"{100 * r.good:.1f}", f"{100 * r.of_most:.1f}"]
        for r in cast("Iterable[Any]", stopping.itertuples())
    ]
    parts = [f"# {title}", markdown_table(head, shares)]
    parts += ["## When to stop", markdown_table(["asked", "looks", "localized", "of all looks' share"], stops)]
    write_text(folder / LOOKS_MD, "\n\n".join(parts) + "\n")
    return table


def _share(value: float, low: float, high: float) -> str:
    return f"{100 * value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"
