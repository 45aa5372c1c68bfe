"""What this package adds to `wheretolook evaluate`: the paper's tables, a figure of occlusion models, sets of looks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.dataset.layout import Dataset
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.tracking.config import TrackingConfig

if TYPE_CHECKING:
    import pandas as pd


def write_reports(folder: Path, table: pd.DataFrame) -> None:
    """Write the paper's tables and, of several occlusion models, `occlusion.png`, from a table of scores."""
    import pandas as pd

    from wheretolook.evaluation.results import OCCLUSION_PNG, VARIANTS_CSV
    from wheretolook.evaluation.scores import main_rows, read_scores
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


def evaluate_look_sets(dataset: Dataset, config: EvaluateConfig, tracking: TrackingConfig, device: str) -> None:
    """Compare sets of looks on the labelled scenes of the split, if their labels have matched pixels."""
    from wheretolook_paper.commands.look_sets import evaluate_looks

    labelled = tuple(scene for scene in dataset.scenes if scene.stage_cache("label").stored_key is not None)
    if any(scene.split == config.split for scene in labelled):
        evaluate_looks(replace(dataset, scenes=labelled), config, tracking, device=device)
