"""Descriptions and saved views of MLflow experiments, registered under the entry point `wheretolook.experiment_notes`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from wheretolook.tracking import AUC, REGRET, SHARE


@dataclass(frozen=True)
class View:
    """A table of runs that an experiment's description leads to: what it is about, its columns, and which runs."""

    about: str
    sort: str  # the metric that runs are sorted by
    columns: tuple[str, ...]  # parameters and further metrics, as MLflow's interface names them
    only: str = ""  # MLflow's filter of runs
    ascending: bool = True

    def state(self) -> str:
        """Return the view as MLflow's interface shares it, in a tag of the experiment."""
        columns = [_column(name) for name in (*self.columns, f"metrics.{self.sort}")]
        sort = {"orderByKey": _column(f"metrics.{self.sort}"), "orderByAsc": self.ascending}
        facets = {"searchFilter": self.only, "startTime": "ALL", "lifecycleFilter": "Active"}
        return json.dumps({**sort, **facets, "selectedColumns": columns})


def _column(name: str) -> str:
    kind, _, key = name.partition(".")
    return f"{kind}.`{key}`"


@dataclass(frozen=True)
class Purpose:
    """Description of the experiment of a stage's runs, and its saved views."""

    note: str  # MLflow shows it as Markdown
    views: Mapping[str, View] = field(default_factory=dict)  # by their names, which are parts of links


_ALL = "params.method LIKE '%' AND params.candidates = 'all'"  # without the run that holds the others
_CHOICES = ("params.method", "params.occlusion", f"metrics.{SHARE}", f"metrics.{AUC}")
_TOP_N = tuple(f"metrics.top-{n}/normalized_0.05m_0.4deg" for n in (1, 5, 10))
_KEPT = "kept_val_average_precision"
_LEARNERS = ("params.learner", "params.trained_on", "params.seed", f"metrics.{AUC}", "metrics.regret_others")
_PATHS = ("params.method", "params.task", "metrics.times_forward", "metrics.times_forward_length")


_FIRST = f"""\
- `{REGRET}`: the oracle's share less the method's; **sort by it, lowest first**
- `{SHARE}`: share of locations where the first view chosen localizes
- `{AUC}`: how well all viewpoints are ordered, not only the chosen ones"""

PURPOSES = {
    "evaluate": Purpose(
        f"""\
Scores of methods that choose views. One run is one evaluation; its own numbers are those of the best method that has
to choose (tag `best`). Open it (+) to compare: it contains a run for each `method` × `occlusion` × `candidates`.

{_FIRST}
- `top-1/…`, `top-5/…`, `top-10/…`: of the best 1, 5 and 10 views of a location, at each limit of the error, `regret`,
  `raw` (the share), `normalized` (the share divided by the oracle's) and `any` (share of locations where one is good)

Keep two of the three parameters fixed to see what the third changes. All methods alike:
`params.occlusion = "mesh" and params.candidates = "all"`; inputs of the paper's network: `params.method LIKE "mlp-%"`.
All other numbers are in the artifact `scores.csv`.""",
        {
            "methods": View("all methods, the best first", REGRET, _CHOICES, _ALL),
            "inputs": View("inputs of the paper's network", REGRET, _CHOICES, f"{_ALL} AND params.method LIKE 'mlp-%'"),
            "top-n": View("the best 1, 5 and 10 views", REGRET, (*_CHOICES[:2], *_TOP_N), _ALL),
        },
    ),
    "looks": Purpose(
        """\
Sets of looks from a place, localized together. Open the run (+) to compare: in it is a run for each `strategy` ×
`n_looks`.

- `good`: share of places where the looks localize together; **sort by it, highest first**
- `gain`: this less the share where the look that is best alone localizes; `any_good`: where one of the looks does
- `sure`, `sure_right`: share of poses called sure at 99 %, and of these the share that is right"""
    ),
    "train": Purpose(
        """\
Trained methods, one run per training. Compare the last epoch kept by `kept_val_average_precision`, highest first, with
`method` next to it; the charts of `val_bce` and `train_bce` by step show overfitting. Weights
and `history.csv` are artifacts.""",
        {"trained": View("what was trained, the best first", _KEPT, ("params.method", f"metrics.{AUC}"), "", False)},
    ),
    "learners": Purpose(
        f"""\
All learners on scenes that they were not trained on. The run's own numbers are those of the learner with
the lowest mean regret (tag `best`). Open it (+) to compare: in it is a run for each `learner` × `trained_on` × `seed`.

- `{REGRET}`, `{AUC}`: on the test scenes; **sort by the first, lowest first**
- `regret_others`, `average_precision_others`: on scenes by others; `…_validation`: what one may choose a learner by

Runs that differ only by `seed` show the random spread.""",
        {"learners": View("all learners, the best first", REGRET, _LEARNERS, "params.learner LIKE '%'")},
    ),
    "adapt": Purpose(
        """\
Weights adapted to single scenes. Compare `regret`, `auc`, `calibration_error` and `log_loss` with the same names ending
in `_before`: all on views that were not trained on. `better` is 1 where the adapted weights were kept."""
    ),
    "paths": Purpose(
        """\
Planned paths whose views were rendered and localized. Open the run (+) to compare: in it is a run for each `method` ×
`task` ("planned": places and views are planned; "given": views along given places).

- `localized`: share of the views along the paths that localize; **sort by it, highest first**
- `times_forward`: this share divided by that of looking forward; `times_forward_length`: the path's length likewise""",
        {"methods": View("all methods, the best first", "localized", _PATHS, "params.method LIKE '%'", False)},
    ),
    "extend": Purpose(
        """\
Maps of renders that photographs extend, a run for each policy within one (open it, +).

- `strict`, `coarse`: share of target views within 5 cm and 0.4°, 25 cm and 2°; **sort by the first, highest first**
- `gain`: points of `strict` over the present map; `won`, `lost`: views that only the extended or present map localizes"""
    ),
    "plan": Purpose(
        "Single paths. Compare `score`, the mean score of the views, and `length_m`; picture and film are artifacts."
    ),
    "label": Purpose(
        """\
Statistics of labels, one run per labelling. `positive_…` are the shares of viewpoints that localize within a limit;
with `train_` or `test_` in front, of that split. `seconds_…` is the time of each step; `labels.md` is an artifact."""
    ),
    "benchmark": Purpose(
        "Measurements. `visibility check`: seconds, a metric for each step and device; tables are artifacts."
    ),
}


def experiment_tags(stage: str, experiment_id: str) -> dict[str, str]:
    """Return the MLflow tags with the description and the saved views of the experiment of a stage's runs."""
    if stage not in PURPOSES:
        return {}
    purpose = PURPOSES[stage]
    links = [f"[{view.about}]({experiment_link(experiment_id, name)})" for name, view in purpose.views.items()]
    note = "\n\n".join(filter(None, (" · ".join(links), purpose.note)))
    views = {f"{_SHARED}{name}": view.state() for name, view in purpose.views.items()}
    return {"mlflow.note.content": note, **views}


def experiment_link(experiment_id: str, view: str) -> str:
    """Return the link to a saved view of an experiment, relative to MLflow's address; not in its part for GenAI."""
    return f"#/experiments/{experiment_id}/runs?workflowType=machine_learning&viewStateShareKey={view}"


def first_view(tags: Mapping[str, str]) -> str:
    """Return the name of the first saved view in the tags of an experiment, "" without any."""
    names = [tag.removeprefix(_SHARED) for tag in tags if tag.startswith(_SHARED)]
    return next((name for purpose in PURPOSES.values() for name in purpose.views if name in names), "")


_SHARED = "mlflow.sharedViewState."  # MLflow 3
