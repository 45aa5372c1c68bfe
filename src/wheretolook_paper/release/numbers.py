"""Numbers of the pages that a release's results hold: for each place in a page, the file and cell that it is of.

A table of a page is found by its header line, its rows by their first cells; a number in prose by a pattern whose groups
are the numbers. `updated` returns a page with today's numbers, so that a test compares it with the page and
`wheretolook_paper.studies.results` writes it.

Not compared, because no table of the release holds them: times and sizes of single machines (docs/localize.md,
docs/features.md, docs/cluster.md, docs/scale.md), learned features, the comparison with hloc and choices on validation
scenes, which were measured once and name their commands; the stopping rule of docs/looks.md, which is in `looks.md` of its
dataset; and other accuracies in docs/check.md, which the steps "kitchen" and "fox" store from their next run on.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook_paper.evaluation.comparison import interval_text
from wheretolook_paper.evaluation.extend import (
    EXTEND_CSV,
    PHOTOGRAPHS_CSV,
    difference,
    outcomes,
    policies,
    registrations,
)

STRICT = "0.05m_0.4deg"

Cells = Callable[[str], list[str]]
"""Returns the cells of a row beside its first, given this one without emphasis and remarks. Raises KeyError for others."""

METHODS = {
    "set of landmarks": "set",
    "expected inliers": "expected-inliers",
    "expected bins": "expected-bins",
    "Fisher, trace, expected": "fisher-trace-expected",
    "random": "random",
    "a random direction": "random",
    "forward, headings drawn": "forward",
    "most visible landmarks": "visible",
    "most visible": "visible",
    "reprojections with bins": "bins",
    "Fisher, min. eigenvalue, exact": "fisher-mineig-exact",
    "Fisher, log det, exact": "fisher-logdet-exact",
    "Fisher, trace, exact": "fisher-trace-exact",
    "Fisher information, trace": "fisher-trace-exact",
    "Fisher, trace, GP": "fisher-trace-gp",
    "MLP, 2d": "mlp-2d",
    "MLP, 2d + z": "mlp-2d+z",
    "MLP, 2d + 3d": "mlp-2d+3d",
    "MLP, trained as the released code": "mlp-released",
    "the paper's network": "mlp-2d+z",
    "set, adapted": "adapted",
    "set, [adapted](adapt.md)": "adapted",
}
"""Methods by their names in tables."""

RANKED = ("set", "expected-inliers", "bins", "visible")
LOOKS = {
    "selected as a set, joint": "together",
    "added one after another, joint": "in-turn",
    "by single scores, 40° apart, joint": "one-by-one",
    "evenly spaced, joint": "even",
    "most visible, joint": "visible",
    "exact Fisher information, joint": "fisher",
    "random, joint": "random",
}
POLICIES = {
    "random": "random",
    "even spread": "even",
    "expected score": "expected",
    "blended by confidence": "blended",
    "expected gain": "gain",
    "score at the true pose": "known",
}


EXTENSIONS = {
    "none": "none",
    "random": "random",
    "even spread": "even",
    "lowest score, apart": "worst",
    "a longer walk": "walk",
    "pairs, by landmarks": "pairs-landmarks",
    "pairs, by depth images": "pairs-depth",
    "pairs, by the mesh": "pairs",
}
"""Policies of extending a map by their names in tables."""

PATHS = "| two test apartments | six other scenes | all | × forward | length / forward's | turning | no path |"


class Numbers:
    """Tables and pages of a checkout.

    Args:
        root: folder of README.md, docs/ and data/release.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.table = cache(lambda name: pd.read_csv(root / "data" / "release" / "results" / name))

    def row(self, file: str, **values: object) -> Any:
        """Return the only row of a table with these values in its columns (a Series), None if there is none."""
        table = self.table(file)
        for column, value in values.items():
            table = table[table[column].astype(str) == str(value)]
        if len(table) > 1:
            raise ValueError(f"{file}: {len(table)} rows of {values}")
        return table.iloc[0] if len(table) else None

    def scores(self, file: str, method: str, occlusion: str = "mesh", scene: str = "all") -> Any:
        """Return the row of the best view of each location among all labelled ones."""
        return self.row(file, method=method, occlusion=occlusion, candidates="all", top_n=1, scene=scene)

    def labelled(self, split: str) -> list[str]:
        """Return locations, viewpoints and the share within 5 cm and 0.4° (%) of a split, "all" for all, from the card."""
        card = (self.root / "data" / "release" / "README.md").read_text(encoding="utf-8")
        (row,) = re.findall(rf"^\| all +\| {split} +\|.*", card, re.MULTILINE)
        locations, viewpoints, share = (cell.strip() for cell in row.split("|")[4:7])
        return [locations, viewpoints, f"{float(share):.0f}"]

    # --- cells of tables

    def readme_scores(self, label: str) -> list[str]:
        return [cell for file in ("scores.csv", "generalization.csv") for cell in self._best(METHODS[label], file)[::2]]

    def all_scores(self, label: str) -> list[str]:
        return [cell for file in ("scores.csv", "generalization.csv") for cell in self._best(METHODS[label], file)]

    def _best(self, method: str, file: str) -> list[str]:
        """Return share with interval, share through walls, AUC; from `variants.csv` what does not ship."""
        found = self.scores(file, method)
        if found is None and file == "scores.csv":
            file = "variants.csv"
            found = self.scores(file, method)
        if found is None:
            return ["–"] * 3
        through = self.scores(file, method, "none")
        return [
            "{:.1f} [{:.1f}, {:.1f}]".format(
                *(100 * found[f"normalized_{end}{STRICT}"] for end in ("", "low_", "high_"))
            ),
            "–" if through is None else f"{100 * through[f'normalized_{STRICT}']:.1f}",
            f"{found['roc_auc']:.3f}",
        ]

    def angles(self, label: str) -> list[str]:
        """Return regret and AUC of four methods on the six scenes, then on the apartments."""
        groups = ("all others'", "all apartment")
        cells = [self._ranked(f"test-{label.rstrip('°')}", group, method) for group in groups for method in RANKED]
        return [f"{row['regret']:.1f}; {row['auc']:.3f}" for row in cells]

    def fisheye(self, label: str) -> list[str]:
        group = {"two apartments": "all apartment", "six other scenes": "all others'"}[label]
        cells = []
        for method in RANKED:
            row = self._ranked("fisheye", group, method)
            regret = f"{row['regret']:.1f}"
            if method == RANKED[0]:
                regret = interval_text(row, "regret", 1)
            cells.append(f"{regret}; {row['auc']:.3f}" + ("" if pd.isna(row["ece"]) else f"; {row['ece']:.2f}"))
        return cells

    def _ranked(self, dataset: str, group: str, method: str) -> Any:
        return self.row("cameras.csv", dataset=dataset, group=group, method=method)

    def photographs(self, scene: str) -> Cells:
        def cells(label: str) -> list[str]:
            row = self.row("photographs.csv", scene=scene, method=METHODS[label])
            columns = (("auc", 3), ("auc_within_blocks", 3), ("regret", 1), ("ece", 3))
            found = [_measured(row, name, digits) for name, digits in columns]
            ratio = row["real_over_expected_localized"]
            return [*found, "" if pd.isna(ratio) else f"{ratio:.2f}"]

        return cells

    def checked(self, label: str) -> list[str]:
        """Return numbers of `check` with the set network and visible landmarks on a map of photographs."""
        scene = "kitchen" if label.startswith("kitchen") else "fox"
        ours, visible = (self.row("photographs.csv", scene=scene, method=method) for method in ("set", "visible"))
        aucs = (f"{row['auc']:.3f} [{row['auc_low']:.2f}, {row['auc_high']:.2f}]" for row in (ours, visible))
        above = interval_text(ours, "auc_above_visible", 1, 3)
        within = (f"{row['auc_within_blocks']:.3f}" for row in (ours, visible))
        found = f"{ours['real_over_expected_localized']:.2f}"
        return [f"{ours['good']} of {ours['views']}", *aucs, above, *within, f"{ours['ece']:.2f}", found]

    def inference(self, label: str) -> list[str]:
        """Return the time of one step at a location, in s, and of one pose, in ms: median, quartiles and shortest."""
        method = METHODS[label.partition(",")[0]]
        device = "cuda" if label.endswith("H100") else "cpu"
        cells = []
        for what, unit, digits, per_s in (("location", "s", 3 if device == "cuda" else 2, 1), ("pose", "ms", 1, 1000)):
            times = self.row("runtimes.csv", what=f"{method}, one {what}", device=device)
            row = per_s * times[["median_s", "q1_s", "q3_s", "min_s"]]
            median, low, high, least = (f"{float(time):.{digits}f}" for time in row)
            cells += [f"{median} {unit} [{low}, {high}]", f"{least} {unit}"]
        return cells

    def paths(self, task: str) -> Cells:
        """Return shares by group of scenes (weighted by views), that of all with interval and ratio, and the rest."""

        def cells(label: str) -> list[str]:
            method = {"forward": "forward"}.get(label) or METHODS[label.removesuffix(", greedy")]
            table = self.table("paths.csv")
            table = table[table["task"] == task]
            table = table[table["method"] == method + (" greedy" if label.endswith("greedy") else "")]
            everywhere = table[table["scene"] == "all"].iloc[0]
            apartments = table["scene"].str.startswith("apartment")
            parts = (table[apartments], table[~apartments & (table["scene"] != "all")])
            shares = [100 * (part["localized"] * part["views"]).sum() / part["views"].sum() for part in parts]
            localized = interval_text(everywhere, "localized")
            row = [*(f"{share:.1f}" for share in shares), localized, f"{everywhere['times_forward']:.2f}"]
            row += [f"{everywhere['times_forward_length']:.2f}", f"{everywhere['turn_deg_per_m']:.0f}°/m"]
            return [*row, f"{everywhere['failures']:.0f} of {everywhere['pairs']:.0f}"]

        return cells

    def masked(self, label: str) -> list[str]:
        scene, _, path = label.partition(": ")
        method = {"shortest, ahead": "forward", "shortest, chosen": "set", "on the mask, chosen": "mask"}[path]
        row = self.row(
            "nav2.csv", scene={"house": "aws_house", "game level": "nexuiz_dieselpower"}[scene], method=method
        )
        turned = f"{row['turn_deg_per_m']:.0f}°/m"
        return [interval_text(row, "localized"), f"{row['length_m']:.2f}", turned, f"{row['pairs']}"]

    def relocalized(self, label: str) -> list[str]:
        row = self.row("relocalize.csv", policy=POLICIES[label])
        joint = [
            f"{100 * row[f'right_{n}']:.1f} [{100 * row[f'right_{n}_low']:.0f}, {100 * row[f'right_{n}_high']:.0f}]"
            for n in (2, 3, 4)
        ]
        stopped = [f"{100 * row['right']:.1f}", f"{row['views']:.2f}"]
        confident = f"{100 * row['confident']:.1f}, {100 * row['precision']:.1f}"
        return [f"{100 * row['right_1']:.1f}", *joint, *stopped, confident]

    def confidence(self, label: str) -> list[str]:
        """Return what is right and predicted of poses on maps of photographs, in the mean over places, with and without factor."""
        table = self.table("confidence.csv")
        # of the kitchen, its whole map counts
        table = table[(table["accuracy_m"] == float(label.split()[0]) / 100) & ~table["map"].str.contains("_")]
        means = table.select_dtypes("number").mean()
        columns = ("right", "predicted", "loss", "predicted_without", "loss_without")
        sure = (f"{table[f'sure_right{kind}'].sum()} of {table[f'sure{kind}'].sum()}" for kind in ("", "_without"))
        return [*(f"{means[name]:.3f}" for name in columns), *sure]

    # --- photographs that extend maps

    @cached_property
    def _extended(self) -> Any:
        """Outcomes of views by policy, of maps of scenes; and the rows of the table by policy."""
        return outcomes(self.table(EXTEND_CSV)), policies(self.table(EXTEND_CSV)).set_index("policy")

    def extended(self, label: str) -> list[str]:
        views, rows = self._extended
        policy = EXTENSIONS[label]
        row = rows.loc[policy]
        cells = [f"{100 * row['strict']:.1f}", f"{100 * row['coarse']:.1f}"]
        if policy != "none":
            cells += [interval_text(row, "gain"), f"{row['won']:.0f} / {row['lost']:.0f}"]
        if policy not in ("none", "pairs"):
            cells.append(interval_text(difference(views, "pairs", policy), "gain"))
        return [*cells, "", "", ""][:5]

    def extended_scene(self, label: str) -> list[str]:
        """Return shares of a scene without and with planned photographs, predicted too, and views gained and lost."""
        name = label.replace(" ", "-") if label.startswith("apartment") else label
        table = self.table(EXTEND_CSV)
        views, _ = self._extended
        of_scene = table[table["scene"] == name].groupby("policy")[["strict", "predicted"]].mean()
        counts = difference(views.loc[[name]], "pairs", "none")
        shares = 100 * of_scene.loc[["none", "pairs"]].to_numpy(np.float64).T.ravel()
        cells = [f"{share:.0f}" for share in shares]
        return [cells[0], cells[1], f"{counts['won']} / {counts['lost']}", cells[2], cells[3]]

    def extended_photographs(self, label: str) -> list[str]:
        name = label.partition(",")[0]
        table = self.table(PHOTOGRAPHS_CSV)
        table = table[table["scene"] == name]
        views = outcomes(table)
        rows = policies(table).set_index("policy")
        shown = [rows.loc[policy] for policy in ("none", "walk", "random", "even", "worst", "pairs")]
        above = [interval_text(difference(views, "pairs", policy), "gain") for policy in ("random", "even")]
        return [*(f"{100 * row['strict']:.1f} / {100 * row['coarse']:.1f}" for row in shown), *above]

    def panoramas(self, label: str) -> list[str]:
        """Return shares right and counts of confident poses, right and confident, of panoramas and single cut-outs."""
        table = self.table("panoramas.csv")
        named = table["scene"] == label
        table = table[named if named.any() else ~table["scene"].str.fullmatch(r"[a-z]+-\d+")]
        right = (table["error_m"] <= 0.05) & (table["error_deg"] <= 0.4)
        sure = table["probability"] >= 0.95
        cells = [f"{(table['method'] == 'panorama').sum()}"]
        for method in ("panorama", "best", "any"):
            of_method = table["method"] == method
            cells.append(f"{100 * right[of_method].mean():.1f}")
            if method != "any":
                cells.append(f"{(right & sure & of_method).sum()} of {(sure & of_method).sum()}")
        return cells

    def looks(self, label: str) -> list[str]:
        rows = [self.row("looks.csv", split="test", strategy=LOOKS[label], n_looks=n) for n in (1, 2, 3, 5)]
        return [*(f"{100 * row['good']:.1f}" for row in rows), f"{100 * rows[-1]['any_good']:.1f}"]


def _measured(row: Any, name: str, digits: int) -> str:
    """Format a measure, with its interval where that is known; "" where the measure is unknown."""
    ends = row[[f"{name}{end}" for end in ("", "_low", "_high")]].astype(float)
    if pd.isna(ends[name]):
        return ""
    if not ends.any():
        return "0"
    return f"{ends[name]:.{digits}f}" if ends.isna().any() else interval_text(ends, name, 1, digits)


def tables(numbers: Numbers) -> Mapping[tuple[str, str], Cells]:
    """Return the cells of each table of the pages, by page and header line."""
    held_out = "| AUC | AUC within groups | regret in points | calibration error | inliers / expected |"
    four = "set | expected inliers | bins | most visible |"
    return {
        ("README.md", "| method | two test apartments | AUC | six other scenes | AUC |"): numbers.readme_scores,
        (
            "docs/results.md",
            "| method | two test apartments | through walls | AUC | six other scenes | through walls | AUC |",
        ): numbers.all_scores,
        ("docs/results.md", f"| field of view | six other scenes: {four} two apartments: {four}"): numbers.angles,
        ("docs/results.md", f"| | {four}"): numbers.fisheye,
        ("docs/results.md", f"| kitchen {held_out}"): numbers.photographs("kitchen"),
        ("docs/results.md", f"| fox {held_out}"): numbers.photographs("fox"),
        ("docs/results.md", f"| places and views planned {PATHS}"): numbers.paths("planned"),
        ("docs/results.md", f"| views along given paths {PATHS}"): numbers.paths("given"),
        (
            "docs/lost.md",
            "| next view | first | two views | three | four | right at stop | views until stop | confident, right of "
            "these |",
        ): numbers.relocalized,
        ("docs/results.md", "| | one location, 500 directions | shortest | one pose | shortest |"): numbers.inference,
        (
            "docs/check.md",
            "| | positive views | AUC: set | visible | difference | within groups: set | visible | calibration error | "
            "inliers / expected |",
        ): numbers.checked,
        (
            "docs/looks.md",
            "| accuracy | right | predicted | log loss | without the factor: predicted | log loss | above 99 %, right of these "
            "| without the factor |",
        ): numbers.confidence,
        (
            "docs/extend.md",
            "| ten photographs more | within 5 cm, 0.4° | within 25 cm, 2° | gain | views gained / lost | pairs above it |",
        ): numbers.extended,
        (
            "docs/extend.md",
            "| scene | none | pairs | views gained / lost | predicted: none | predicted: pairs |",
        ): numbers.extended_scene,
        (
            "docs/extend.md",
            "| photographs | none | a longer walk | random | even spread | lowest score | pairs | above random | above even |",
        ): numbers.extended_photographs,
        (
            "docs/rigs.md",
            "| scenes | places | panorama | confident, right | most probable face | confident, right | any face |",
        ): numbers.panoramas,
        (
            "docs/nav2.md",
            "| path, views | localized, % of the way | mean length, m | turning | pairs |",
        ): numbers.masked,
        ("docs/looks.md", "| views | one | two | three | five | any of five alone |"): numbers.looks,
    }


def prose(numbers: Numbers) -> Mapping[tuple[str, str], list[str]]:
    """Return the numbers of each pattern, by page and pattern, in the order of its groups."""
    two, single = (numbers.row("looks.csv", split="test", strategy="together", n_looks=n)["good"] for n in (2, 1))
    rates = {policy: numbers.row("relocalize.csv", policy=policy) for policy in ("gain", "even", "known")}
    closed = [
        f"{100 * (rates['gain'][name] - rates['even'][name]) / (rates['known'][name] - rates['even'][name]):.0f}"
        for name in ("right_2", "right_3", "right_4")
    ]
    looks = [f"{100 * share:.0f}" for share in (two, single)]
    sets = numbers.table("looks.csv")
    sets = sets[sets["split"] == "test"]
    sure = (sets["sure"] * sets["n_locations"]).round()
    correct = (sure * sets["sure_right"]).round()
    gains = []
    for n in (2, 3, 5):
        row = numbers.row("looks.csv", split="test", strategy="together", n_looks=n)
        gains += [f"{100 * row[name]:.1f}" for name in ("gain", "gain_low", "gain_high")]
    turned = [f"{100 * rates[policy]['right_4']:.0f}" for policy in ("gain", "even")]
    ours, other = "scores.csv", "generalization.csv"
    paired = []
    for method in ("bins", "mlp-2d+z"):
        for file in (ours, other):
            row = numbers.scores(file, method)
            mean, high, low = (-100 * row[f"difference_{end}{STRICT}"] for end in ("", "low_", "high_"))
            paired += [f"{mean:+.1f}", f"{low:.1f}", f"{high:.1f}"]
    levels = numbers.table(other)
    levels = levels[(levels["occlusion"] == "mesh") & (levels["top_n"] == 1) & levels["scene"].str.startswith("nexuiz")]
    by_set, by_bins = (levels[levels["method"] == method] for method in ("set", "bins"))
    house = numbers.scores(other, "set", scene="aws_house")
    tested = numbers.table("cameras.csv")
    tested = tested[tested["dataset"].str.startswith("test-") & (tested["method"] == "set")]
    errors = [tested[tested["group"] == group]["ece"] for group in ("all apartment", "all others'")]
    kitchen, fox = (numbers.row("photographs.csv", scene=scene, method="set") for scene in ("kitchen", "fox"))
    held_out = [str(int(row[name])) for row in (kitchen, fox) for name in ("good", "views", "blocks")]
    shares = [f"{100 * row['good'] / row['views']:.0f}" for row in (fox, kitchen)]
    predicted = [f"{100 * row['predicted']:.0f}" for row in (fox, kitchen)]
    _, n_views, _ = numbers.labelled("all")
    n_locations, _, share = numbers.labelled("test")
    interiors = numbers.scores(other, "random")  # its share is that of all views, as many at each location
    planned = numbers.table(EXTEND_CSV)
    registered = registrations(planned[planned["policy"] == "pairs"])
    likely = registered[registered["p"] >= 0.3]
    of_policy = {name: rows.set_index(["scene", "seed"]) for name, rows in planned.groupby("policy")}
    greedy = of_policy["oracle"].index
    oracle = [f"{100 * of_policy[name].loc[greedy, 'strict'].mean():.0f}" for name in ("none", "pairs", "oracle")]
    extended = [numbers.extended(label)[0] for label in ("none", "pairs, by the mesh", "random")]
    number = r"(-?[+\d.]+)"
    pair = rf"{number} points on the apartments \[{number}, {number}\] and {number} on the six scenes"
    return {
        ("docs/extend.md", r"Of (\d+) photographs with a probability of at least 0.3, (\d+) % register"): [
            f"{len(likely)}",
            f"{100 * likely['registered'].mean():.0f}",
        ],
        ("docs/extend.md", r"mean probability of all (\d+) is ([\d.]+), and ([\d.]+) of them register"): [
            f"{len(registered)}",
            *(f"{registered[name].mean():.2f}" for name in ("p", "registered")),
        ],
        ("docs/extend.md", r"from (\d+) to (\d+) %, where greedy choices by real maps reach (\d+) %"): oracle,
        ("README.md", r"localize from ([\d.]+) to ([\d.]+) %, ten random ones to ([\d.]+) %"): extended,
        ("README.md", r"([\d,]+) labelled viewpoints ship"): [n_views],
        ("docs/results.md", r"contains ([\d,]+) labelled viewpoints"): [n_views],
        ("docs/results.md", r"Two test apartments\*\* .* (\d+) locations .* (\d+) % localize"): [n_locations, share],
        ("docs/differences.md", r"positive test views \| 30 % \| – \| (\d+) %"): [share],
        ("docs/results.md", r"Six other scenes\*\* .* (\d+) locations .* (\d+) % localize"): [
            f"{interiors['n_locations']:.0f}",
            f"{100 * interiors[f'raw_{STRICT}']:.0f}",
        ],
        ("README.md", r"two localize at (\d+) of 100 .* single view localizes at (\d+)"): looks,
        ("README.md", r"([\d,]+) of ([\d,]+) poses with a confidence"): [f"{correct.sum():,.0f}", f"{sure.sum():,.0f}"],
        ("docs/looks.md", r"([\d,]+) of ([\d,]+) sets have a .*; ([\d,]+) of these are correct"): [
            *(f"{count:,.0f}" for count in (sure.sum(), sets["n_locations"].sum(), correct.sum()))
        ],
        (
            "docs/looks.md",
            rf"\+{number} points with two views \({number} to {number}\), \+{number} with three \({number} to {number}\), "
            rf"\+{number} with five \({number} to {number}\)",
        ): gains,
        ("README.md", r"after four views (\d+) of 100 poses are correct, (\d+) by even"): turned,
        ("docs/lost.md", r"close (\d+) % after two views, (\d+) % after three and (\d+) % after four"): closed,
        (
            "docs/results.md",
            rf"against bins {pair} \[{number}, {number}\]; against the paper's network {number} \[{number}, {number}\] "
            rf"and {number} \[{number}, {number}\]",
        ): paired,
        ("docs/results.md", r"ECE ([\d.]+) to ([\d.]+); ([\d.]+) in the simulator's house"): [
            *_range(by_set["ece"]),
            f"{house['ece']:.2f}",
        ],
        ("docs/results.md", r"AUC ([\d.]+) to ([\d.]+), bins ([\d.]+) to ([\d.]+)"): [
            *_range(by_set["roc_auc"]),
            *_range(by_bins["roc_auc"]),
        ],
        ("docs/results.md", r"error is ([\d.]+) to ([\d.]+) on the apartments and ([\d.]+) to ([\d.]+) on"): [
            end for values in errors for end in _range(values)
        ],
        (
            "docs/results.md",
            r"(\d+) of (\d+) views in (\d+) groups localize\) and .* (\d+) of (\d+) views in (\d+) groups",
        ): held_out,
        ("docs/results.md", r"\((\d+) % localize where (\d+) % were predicted\)"): [shares[0], predicted[0]],
        ("docs/results.md", r"In the kitchen (\d+) % localize where (\d+) %"): [shares[1], predicted[1]],
    }


def _range(values: pd.Series) -> list[str]:
    return [f"{values.min():.2f}", f"{values.max():.2f}"]


def updated(page: str, numbers: Numbers) -> str:
    """Return a page's text with the numbers that the results hold now.

    Raises ValueError if a table or a pattern is not in the page, KeyError if a table has a row of an unknown name, so that
    a rewritten page is noticed.
    """
    lines = (numbers.root / page).read_text(encoding="utf-8").splitlines()
    for (where, header), cells in tables(numbers).items():
        if where != page:
            continue
        start = lines.index(header) + 2
        for index in range(start, len(lines)):
            if not lines[index].startswith("|"):
                break
            first = lines[index].strip("|").split("|")[0].strip()
            found = cells(re.sub(r" \((ships|not kept|MLP).*\)$", "", first.replace("**", "")))
            lines[index] = re.sub(r"\|  (?=\|)", "| ", f"| {' | '.join([first, *found])} |")
    text = "\n".join(lines) + "\n"
    for (where, pattern), values in prose(numbers).items():
        if where != page:
            continue
        matches = [*re.finditer(pattern, text)]
        if len(matches) != 1:
            raise ValueError(f"{page}: {len(matches)} places match {pattern}")
        match = matches[0]
        for group in range(len(values), 0, -1):
            start, end = match.span(group)
            text = text[:start] + values[group - 1] + text[end:]
    return text


def pages(numbers: Numbers) -> list[str]:
    """Return the pages that have numbers of the results."""
    return sorted({page for page, _ in [*tables(numbers), *prose(numbers)]})
