"""The cards of a release, of its data and of its weights, in Markdown with the header that the Hugging Face hub reads."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from wheretolook.dataset.config import ALL, THRESHOLDS, Split, threshold_key, threshold_label
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import POSITIVE, label_shares, pooled_labels
from wheretolook.evaluation.config import SCORES_CSV, VARIANTS_CSV
from wheretolook.evaluation.results import read_scores
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.scorers.registry import learned
from wheretolook.scorers.weights import resolve_weights
from wheretolook.training.config import DECIDING
from wheretolook.training.provenance import training_fingerprint
from wheretolook.utils.errors import TableError, WeightsError
from wheretolook.utils.files import read_json_object, sha256
from wheretolook.utils.texts import markdown_table
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.evaluation.score_report import comparisons_markdown, score_markdown
from wheretolook_paper.release.copy import CARD, read_about, size_text, sizes
from wheretolook_paper.release.training_histories import records
from wheretolook_paper.styles import PAPER_NETWORKS, method_style

GENERALIZATION_CSV = "generalization.csv"
GENERALIZATION_MD = "generalization.md"
"""In `results/`: scores on other datasets, as `scores.csv` with the columns `dataset` and `weights_sha256` (of the best
weights at that time; rows of other weights are not shown), and a description of these datasets."""

TAGS = ["visual-localization", "active-localization", "viewpoint-selection", "structure-from-motion", "robotics"]

_LEARNER_METRICS = ("average_precision", "roc_auc", "bce")


def release_cards(release: Dataset, defaults: Mapping[str, Any]) -> dict[Path, str]:
    """Return the card of the data and that of the weights by their files; equal files give equal bytes.

    The first shows the settings that differ from `defaults`, JSON values.

    Raises:
        WeightsError: not exactly one of the paper's networks ships, or a record of training is missing.
        TableError: there are no scores, or no labels.
        ConfigError: the description of the release is missing or damaged.
        StorageError: the release is too large.
    """
    about = read_about(release)
    tables = {scene.name: scene.read_table() for scene in release.scenes}
    shares = label_shares(pooled_labels(tables, {scene.name: scene.split for scene in release.scenes}))
    changed = _difference(about["settings"], defaults)
    contents: dict[str, Any] = dict(
        about=about,
        scenes=about["settings"]["scenes"],
        name=release.name,
        n_scenes=len(release.scenes),
        total=shares.iloc[-1],
        n_views={row["split"]: row["n_views"] for row in shares[shares["scene"] == ALL].to_dict("records")},
        limits=threshold_label(threshold_key(THRESHOLDS[0])),
        label_table=_label_table(release, shares),
        labels=_labels(release),
        changed=yaml.safe_dump(changed, sort_keys=False, default_flow_style=None, width=110),
        has_cameras=all(scene.mapping_cameras.is_file() for scene in release.scenes),
        fingerprints=_fingerprints(release, about),
        sizes=_size_text(release, shares.iloc[-1]["n_views"]),
        **_weights(release),
        **_scores(release, about["source"]),
    )
    data = _data_header(release, about["source"], int(shares.iloc[-1]["n_views"]))
    return {
        release.root / CARD: data + _filled("card.md.j2", contents),
        release.root / "weights" / CARD: _model_header(contents) + _filled("model_card.md.j2", contents),
    }


def _filled(template: str, contents: Mapping[str, Any]) -> str:
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"pairs": _pairs, "thousands": "{:,}".format}
    text = environment.from_string(Path(__file__).with_name(template).read_text(encoding="utf-8")).render(contents)
    return re.sub(r"\n{3,}", "\n\n", text)


def _data_header(release: Dataset, source: str, n_views: int) -> str:
    """Return the hub's header of a dataset: its tables of viewpoints by split, under the hub's names."""
    splits = []
    names: dict[Split, str] = {"train": "train", "val": "validation", "test": "test"}
    for split, name in names.items():
        paths = [scene.table.relative_to(release.root).as_posix() for scene in release.split(split)]
        if paths:
            splits.append({"split": name, "path": paths})
    magnitudes = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M")
    size = magnitudes[sum(n_views >= 10**power for power in (3, 4, 5, 6))]
    header = {"license": "apache-2.0", "pretty_name": f"wheretolook: {source}", "task_categories": ["robotics"]}
    return _header(
        header | {"size_categories": [size], "configs": [{"config_name": "viewpoints", "data_files": splits}]}
    )


def _model_header(contents: Mapping[str, Any]) -> str:
    """Return the hub's header of a model, with the validation metrics of the weights that score by default."""
    metrics = [{"type": name, "value": round(value, 4)} for name, value in contents["metrics"].items()]
    dataset = {"name": f"{contents['validated_on']}, validation views", "type": "wheretolook"}
    result = {"task": {"type": "robotics", "name": "whether a view localizes"}, "dataset": dataset, "metrics": metrics}
    header = {"license": "apache-2.0", "library_name": "wheretolook", "pipeline_tag": "robotics"}
    return _header(header | {"model-index": [{"name": contents["best"], "results": [result]}]})


def _header(values: Mapping[str, Any]) -> str:
    return f"---\n{yaml.safe_dump({**values, 'tags': TAGS}, sort_keys=False)}---\n\n"


def _weight_files(release: Dataset) -> list[Path]:
    return sorted((release.root / "weights").glob("*.safetensors"))


def _best(release: Dataset) -> Path:

    best = resolve_weights(path=release.root / "weights")
    assert best is not None
    return best


def _scores(release: Dataset, source: str) -> dict[str, Any]:
    """Return the tables of scores: of what ships, of all that was trained, and on other datasets."""
    results = release.root / "results"
    if not (results / SCORES_CSV).is_file():
        raise TableError("there are no scores", path=results / SCORES_CSV, fix="Run `wheretolook evaluate`.")
    scores, variants, others = (_read(results / name) for name in (SCORES_CSV, VARIANTS_CSV, GENERALIZATION_CSV))
    if len(others):
        others = others[others["weights_sha256"] == sha256(_best(release))].drop(columns="weights_sha256")
    parts = others.groupby("dataset", sort=False) if len(others) else ()
    description = results / GENERALIZATION_MD
    return {
        "scores": _score_table(scores, source),
        "variants": _score_table(variants, source),
        "brief": _brief({source: scores, **{str(name): part for name, part in parts}}),
        "others": [_score_table(part.drop(columns="dataset"), str(name)) for name, part in parts],
        "others_about": description.read_text().strip("\n") if description.is_file() else "",
    }


def _read(path: Path) -> pd.DataFrame:
    return read_scores(path) if path.is_file() else pd.DataFrame()


def _score_table(scores: pd.DataFrame, dataset: str) -> str:
    """Format scores and their comparisons with headings two levels lower; empty without scores."""
    if scores.empty:
        return ""
    markdown = score_markdown(scores, f"Localization score on {dataset}")
    details = re.search(r"^## (Calibration|Probes)", markdown, re.MULTILINE)
    at = details.start() if details else len(markdown)
    parts = (markdown[:at], comparisons_markdown(scores), markdown[at:])
    joined = "\n\n".join(part.strip("\n") for part in parts if part.strip())
    return re.sub(r"^#", "###", joined, flags=re.MULTILINE)


def _brief(scores: Mapping[str, pd.DataFrame]) -> str:
    """Return a table of the methods' scores at the strictest thresholds over all scenes, by dataset."""
    column = f"normalized_{threshold_key(THRESHOLDS[0])}"
    rows = []
    for dataset, table in scores.items():
        of_all = table[(table["scene"] == ALL) & (table["candidates"] == "all") & (table["top_n"] == 1)]
        of_all = of_all[of_all["occlusion"] == of_all["occlusion"].iloc[0]]
        for _, row in of_all.iterrows():
            rows.append(
                [dataset, method_style(row["method"]).label, f"{100 * row[column]:.1f}", f"{row['roc_auc']:.3f}"]
            )
    return markdown_table(["dataset", "method", "localized, %", "AUC"], rows)


def _label_table(release: Dataset, shares: pd.DataFrame) -> str:
    landmarks = {scene: len(Landmarks.load(scene.landmarks)) for scene in release.scenes}
    lines = []
    for row in shares.to_dict("records"):
        of_row = [n for x, n in landmarks.items() if row["scene"] in (ALL, x.name) and row["split"] in (ALL, x.split)]
        counts = [f"{n:,}" for n in (sum(of_row), row["n_locations"], row["n_views"])]
        lines.append([row["scene"], row["split"], *counts, *[f"{100 * row[column]:.1f}" for column in POSITIVE]])
    limits = [threshold_label(threshold_key(threshold)) for threshold in THRESHOLDS]
    return markdown_table(["scene", "split", "landmarks", "locations", "viewpoints", *limits], lines)


def _labels(release: Dataset) -> dict[str, Any]:
    """Return extractor, localizer and versions of the labels; empty if no scene records them."""
    files = [scene.label_manifest for scene in release.scenes if scene.label_manifest.is_file()]
    manifests = [read_json_object(path) for path in files]
    if not manifests:
        return {}
    versions = {}
    for package in manifests[0]["versions"]:
        used = {manifest["versions"].get(package, "unknown") for manifest in manifests}
        versions[package] = " and ".join(sorted(used))
    return {**manifests[0], "versions": versions}


def _difference(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return what differs from the defaults, in nested mappings too."""
    changed = {}
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            value = _difference(value, default)
            default = {}
        if value != default:
            changed[name] = value
    return changed


def _weights(release: Dataset) -> dict[str, Any]:
    """Describe the shipped weights and the training of the paper's network and of the other learners."""
    files = {path.stem: path for path in _weight_files(release)}
    networks = [name for name in PAPER_NETWORKS if name in files]
    if len(networks) != 1:
        fix = f"Run `wheretolook release --config configs/{release.name}.yaml`."
        problem = "a release ships the weights of one of the paper's networks"
        raise WeightsError(problem, path=release.root / "weights", value=networks, fix=fix)
    known = {path.stem: record for path, record in records(release.root / "weights").items()}
    network = known[networks[0]]
    best = known[_best(release).stem]
    about = network["about"]
    alike = [network]
    for name, other in known.items():
        if name != networks[0] and {**other["about"], "method": about["method"]} == about:
            alike.append(other)
    metrics = [name.removeprefix("val_") for name in network["metrics"] if name.startswith("val_")]
    epochs = [[_label(one), "no" if one is not network else "yes", _epoch(one)] for one in alike]
    folder = learned()[networks[0]].folder
    learners = [
        {**known[name]["about"], "label": _label(known[name]), "ships": name in files, "record": known[name]}
        for name, method in learned().items()
        if method.folder != folder and name in known
    ]
    for one in learners:
        one["options"] = {name: value for name, value in one["config"].items() if name not in DECIDING}
    rows = [[one["label"], "yes" if one["ships"] else "no", str(one["dataset"])] for one in learners]
    return {
        "best": best["about"]["method"],
        "validated_on": str(best["about"]["dataset"]),
        "metrics": {name: best["metrics"][f"val_{name}"] for name in ("average_precision", "roc_auc")},
        "network": about["method"],
        "label_of": lambda method: method_style(method).label,
        "files": [path.name for path in files.values()],
        "config": about["config"],
        "epoch": _epoch(network),
        "network_table": _table(["network", "ships", "epoch"], epochs, metrics, alike),
        "learners": learners,
        "learner_table": _table(
            ["beside it", "ships", "dataset"], rows, _LEARNER_METRICS, [one["record"] for one in learners]
        ),
    }


def _label(record: Mapping[str, Any]) -> str:
    return method_style(record["about"]["method"]).label


def _epoch(record: Mapping[str, Any]) -> str:
    return f"{record['metrics']['epoch'] + 1:.0f}"


def _table(
    header: list[str], rows: list[list[str]], metrics: Sequence[str], trained: Sequence[Mapping[str, Any]]
) -> str:
    """Format rows followed by the validation metrics of their records of training."""
    lines = [
        [*row, *[f"{record['metrics'].get(f'val_{name}', float('nan')):.4f}" for name in metrics]]
        for row, record in zip(rows, trained, strict=True)
    ]
    return markdown_table([*header, *[name.replace("_", " ") for name in metrics]], lines)


def _fingerprints(release: Dataset, about: Mapping[str, Any]) -> str:

    rows = [
        ["dataset", release.fingerprint()],
        ["its train and val scenes", training_fingerprint(release)],
        [f"{about['source']}, from which it was made", about["source_fingerprint"]],
    ]
    rows += [[f"weights/{path.name}, SHA-256", sha256(path)] for path in _weight_files(release)]
    return markdown_table(["what", "fingerprint"], rows)


def _size_text(release: Dataset, n_views: int) -> str:
    parts = sizes(release.root)
    n_landmarks = sum(len(Landmarks.load(scene.landmarks)) for scene in release.scenes)
    n_locations = sum(len(StoredOcclusion.load(scene.occlusion).locations) for scene in release.scenes)
    shown = {name: size for name, size in parts.items() if size and name != "text"}
    each = f"{parts['tables'] / n_views:.1f} bytes a viewpoint, {parts['landmarks'] / n_landmarks:.1f} a landmark"
    return f"{size_text(shown)}; {each}, {parts['occlusion'] / n_locations:.0f} a location"


def _pairs(values: Mapping[str, Any]) -> str:
    texts = []
    for name, value in values.items():
        if isinstance(value, Sequence) and not isinstance(value, str):
            value = (", " if value and isinstance(value[0], str) else " × ").join(map(str, value))
        texts.append(f"{name} {'none' if value is None else value}")
    return ", ".join(texts)
