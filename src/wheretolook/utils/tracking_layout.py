"""How runs are arranged in MLflow: which experiment a run goes to, what it says there, and how runs are named.

Each dataset and purpose has an experiment, such as `release: evaluation`. A run is named

    <what was run>[, <condition>]... (<stage> <dataset>)

such as "all methods (evaluate release)", "set, mesh, best 100 (evaluate release)" or "set (train release)": what tells
runs apart comes first, since MLflow cuts long names.
"""

from __future__ import annotations

from dataclasses import dataclass

REGRET, SHARE, AUC = "1_regret", "1_share", "1_auc"
"""Metrics to sort runs by: the first view chosen (N = 1), at the strictest threshold. MLflow orders columns by name,
digits first."""


BEST_TAG = "best"  # tag of a run that compares: the method or learner whose metrics to sort by it carries

ALL_METHODS = "all methods"  # what was run in a comparison of methods


@dataclass(frozen=True)
class Purpose:
    """What the runs of a stage are for: the end of their experiment's name, and what to look at there."""

    name: str
    note: str  # MLflow shows it as Markdown


_FIRST = f"""\
- `{REGRET}`: the oracle's share less the method's; **sort by it, lowest first**
- `{SHARE}`: share of locations where the first view chosen localizes
- `{AUC}`: how well all viewpoints are ordered, not only the chosen ones"""

PURPOSES = {
    "evaluate": Purpose(
        "evaluation",
        f"""\
How well methods choose where to look. One run is one evaluation; its own numbers are those of the best method that has
to choose (tag `best`). Open it (+) to compare: in it is a run for each `method` × `occlusion` × `candidates`.

{_FIRST}
- `top-1/…`, `top-5/…`, `top-10/…`: of the best 1, 5 and 10 views of a location, at each limit of the error, `regret`,
  `raw` (the share), `normalized` (the share divided by the oracle's) and `any` (share of locations where one is good)

Keep two of the three parameters fixed to see what the third changes. All methods alike:
`params.occlusion = "mesh" and params.candidates = "all"`; inputs of the paper's network: `params.method LIKE "mlp-%"`.
All other numbers lie in the artifact `scores.csv`.""",
    ),
    "train": Purpose(
        "training",
        """\
What was trained, a run for each time. Compare the last epoch kept by `kept_val_average_precision`, highest first, with
`method` beside it; the charts of `val_bce` and `train_bce` by step tell whether a network has learnt too long. Weights
and `history.csv` are artifacts.""",
    ),
    "learners": Purpose(
        "learners",
        f"""\
Everything that can learn, on scenes that it has not learnt from. The run's own numbers are those of the learner with
the lowest mean regret (tag `best`). Open it (+) to compare: in it is a run for each `learner` × `learnt_from` × `seed`.

- `{REGRET}`, `{AUC}`: on the test scenes; **sort by the first, lowest first**
- `regret_others`, `average_precision_others`: on scenes by others; `…_validation`: what one may choose a learner by

Runs that differ by `seed` alone tell how much of a difference is luck.""",
    ),
    "adapt": Purpose(
        "adapting",
        """\
Weights adapted to single scenes. Compare `regret`, `auc`, `calibration_error` and `log_loss` with the same names ending
in `_before`: all of views that were not learnt from. `better` is 1 where the adapted weights were kept.""",
    ),
    "paths": Purpose(
        "paths",
        """\
Planned paths whose views were rendered and localized. Open the run (+) to compare: in it is a run for each `method` ×
`task` ("planned": places and views are planned; "given": views along given places).

- `localized`: share of the views along the paths that localize; **sort by it, highest first**
- `times_forward`: this share divided by that of looking forward; `times_forward_length`: the path's length likewise""",
    ),
    "plan": Purpose(
        "plans",
        "Single paths. Compare `score`, the mean score of the views, and `length_m`; picture and film are artifacts.",
    ),
    "label": Purpose(
        "labels",
        """\
How the labels came out, a run for each time. `positive_…` are the shares of viewpoints that localize within a limit;
with `train_` or `test_` in front, of that split. `seconds_…` is the time of each step; `labels.md` is an artifact.""",
    ),
    "benchmark": Purpose(
        "benchmarks",
        "Measurements. `visibility check`: seconds, a metric for each step and device; tables are artifacts.",
    ),
}


def experiment_name(stage: str, dataset: str) -> str:
    """The experiment of a stage's runs about a dataset, such as "release: evaluation"; "" for no dataset."""
    purpose = PURPOSES[stage].name if stage in PURPOSES else stage
    return ": ".join(filter(None, (dataset, purpose)))


def note_of(stage: str) -> str:
    """What the description of that experiment says."""
    return PURPOSES[stage].note if stage in PURPOSES else ""


def run_name(what: str, stage: str, dataset: str) -> str:
    """A run's name; `what` says what was run, and under which conditions, see `joined`."""
    return f"{what} ({' '.join(filter(None, (stage, dataset)))})"


def joined(what: str, *conditions: str) -> str:
    """What was run and its conditions, those that are not empty, separated by commas."""
    return ", ".join(filter(None, (what, *conditions)))
