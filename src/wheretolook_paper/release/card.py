"""The card of a release in Markdown, `card.md.j2` filled in: contents, scores, training and fingerprints."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.thresholds import ALL, THRESHOLDS, threshold_key, threshold_label
from wheretolook.evaluation.report import score_markdown
from wheretolook.evaluation.results import SCORES_CSV, VARIANTS_CSV
from wheretolook.evaluation.scores import read_scores
from wheretolook.localization.report import POSITIVE, label_summary
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.scorers.registry import learned
from wheretolook.scorers.styles import method_style
from wheretolook.training.config import DECIDING
from wheretolook.utils.errors import TableError, WeightsError
from wheretolook.utils.files import sha256, write_text
from wheretolook.utils.markdown import markdown_table
from wheretolook.utils.reading import read_json_object
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.evaluation.comparisons import comparisons_markdown
from wheretolook_paper.release.copy import CARD, SHELF, read_about, size_text, sizes

GENERALIZATION_CSV = "generalization.csv"
GENERALIZATION_MD = "generalization.md"
"""In `results/`: scores on other datasets, as `scores.csv` with the columns `dataset` and `weights_sha256` (of the best
weights at that time; rows of other weights are not shown), and a description of these datasets."""

TEMPLATE = Path(__file__).with_name("card.md.j2")

_LEARNER_METRICS = ("average_precision", "roc_auc", "bce")


def write_card(release: Dataset, defaults: Mapping[str, Any]) -> Path:
    """Write `<release>/README.md` from the files in the release's folder and return its path; see `release_card`."""
    path = release.root / CARD
    write_text(path, release_card(release, defaults))
    return path


def release_card(release: Dataset, defaults: Mapping[str, Any]) -> str:
    """Return the card; equal files give equal bytes. It shows the settings that differ from `defaults`, JSON values.

    Raises:
        WeightsError: not exactly one of the paper's networks ships, or a record of training is missing.
        TableError: there are no scores, or no labels.
        ConfigError: the description of the release is missing or damaged.
        StorageError: the release is too large.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    about = read_about(release)
    network = _network(release)
    tables = {scene.name: scene.read_table() for scene in release.scenes}
    shares = label_summary(tables, {scene.name: scene.split for scene in release.scenes}).shares
    total = shares.iloc[-1]
    scenes = about["settings"]["scenes"]
    changed = _difference(about["settings"], defaults)
    text = template.render(
        source=about["source"],
        version=about["code_version"],
        config=f"configs/{release.name}.yaml",
        root=f"data/{release.name}",
        n_views=f"{total['n_views']:,}",
        n_locations=f"{total['n_locations']:,}",
        n_scenes=len(release.scenes),
        limits=threshold_label(threshold_key(THRESHOLDS[0])),
        scenes=_scenes_text(scenes),
        meshes=", ".join(mesh["name"] for mesh in scenes["meshes"]),
        label_table=_label_table(release, shares),
        labelled_with=_label_text(release),
        changed=yaml.safe_dump(changed, sort_keys=False, default_flow_style=None, width=110),
        has_cameras=all(scene.mapping_cameras.is_file() for scene in release.scenes),
        fingerprints=_fingerprints(release, about),
        sizes=_size_text(release),
        **_scores(release, network, about["source"]),
        **_training(network, shares),
        **_learners(network),
    )
    return re.sub(r"\n{3,}", "\n\n", text)


def _weights(release: Dataset) -> list[Path]:
    return sorted((release.root / "weights").glob("*.safetensors"))


def _network(release: Dataset) -> Path:
    """Return the weights of the paper's network."""
    networks = [name for name, method in learned().items() if method.ships == "network"]
    found = [path for path in _weights(release) if path.stem in networks]
    if len(found) != 1:
        problem = "a release ships the weights of one of the paper's networks"
        fix = f"Run `wheretolook release --config configs/{release.name}.yaml`."
        raise WeightsError(problem, path=release.root / "weights", value=[path.name for path in found], fix=fix)
    return found[0]


def _scores(release: Dataset, network: Path, source: str) -> dict[str, Any]:
    """Return names of the weights, and the tables of scores."""
    from wheretolook.training.weights import read_training
    from wheretolook.weights.resolve import resolve_weights

    results = release.root / "results"
    if not (results / SCORES_CSV).is_file():
        raise TableError("there are no scores", path=results / SCORES_CSV, fix="Run `wheretolook evaluate`.")
    best = resolve_weights(path=network.parent)
    assert best is not None
    shipped = f"{method_style(read_training(network)['method']).label}, half precision"
    if best != network:
        shipped = f"{method_style(read_training(best)['method']).label}; and of the paper's best network, {shipped}"
    *names, last = [path.name for path in _weights(release)]
    others = _read(results / GENERALIZATION_CSV)
    others = others[others["weights_sha256"] == sha256(best)].drop(columns="weights_sha256") if len(others) else others
    parts = others.groupby("dataset", sort=False) if len(others) else ()
    about = results / GENERALIZATION_MD
    return {
        "shipped": shipped,
        "names": " and ".join(filter(None, [", ".join(names), last])),
        "scores": _score_table(read_scores(results / SCORES_CSV), source),
        "variants": _score_table(_read(results / VARIANTS_CSV), source),
        "others": [_score_table(part.drop(columns="dataset"), str(name)) for name, part in parts],
        "others_about": about.read_text().strip("\n") if about.is_file() else "",
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


def _scenes_text(scenes: Mapping[str, Any]) -> str:
    generated = scenes["train"] + scenes["val"] + scenes["test"]
    parts = []
    if generated:
        first = scenes["seed"]
        kinds = [*scenes.get("kinds", ["apartment"])]
        what = "apartments" if kinds == ["apartment"] else f"scenes ({', '.join(kinds)} in turn)"
        parts.append(f"{generated} generated {what} with seeds {first} to {first + generated - 1}")
    if scenes["meshes"]:
        parts.append(f"{len(scenes['meshes'])} meshes made by others")
    return f"{' and '.join(parts).capitalize()}. A scene belongs to one split."


def _label_table(release: Dataset, shares: pd.DataFrame) -> str:
    landmarks = {scene: len(Landmarks.load(scene.landmarks)) for scene in release.scenes}
    lines = []
    for row in shares.to_dict("records"):
        of_row = [n for x, n in landmarks.items() if row["scene"] in (ALL, x.name) and row["split"] in (ALL, x.split)]
        counts = [f"{n:,}" for n in (sum(of_row), row["n_locations"], row["n_views"])]
        lines.append([row["scene"], row["split"], *counts, *[f"{100 * row[column]:.1f}" for column in POSITIVE]])
    limits = [threshold_label(threshold_key(threshold)) for threshold in THRESHOLDS]
    return markdown_table(["scene", "split", "landmarks", "locations", "viewpoints", *limits], lines)


def _label_text(release: Dataset) -> str:
    """Describe extractor, localizer and versions of the labels; empty if no scene records them."""
    manifests = []
    for scene in release.scenes:
        if scene.label_manifest.is_file():
            try:
                manifests.append(read_json_object(scene.label_manifest))
            except (OSError, ValueError) as error:
                raise TableError(f"not a manifest of labels: {error}", path=scene.label_manifest) from error
    if not manifests:
        return ""
    first = manifests[0]
    versions = {}
    for package in first["versions"]:
        used = {manifest["versions"].get(package, "unknown") for manifest in manifests}
        versions[package] = " and ".join(sorted(used))
    made = f"Keypoints: {_pairs(first['extractor'])}. Localizer: {_pairs(first['localizer'])}."
    return f"{made} Labelled with {_pairs(versions)}."


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


def _training(network: Path, shares: pd.DataFrame) -> dict[str, Any]:
    """Describe the training of the shipped network and of the others trained the same way."""
    from wheretolook.training.weights import read_record, read_training
    from wheretolook_paper.release.training_histories import records

    training = read_training(network)
    record = read_record(network)
    config = training["config"]
    n_views = {row["split"]: row["n_views"] for row in shares[shares["scene"] == ALL].to_dict("records")}
    validated = f"{100 * config['val_fraction']:g} % of each scene's locations held out for validation"
    if "val" in n_views:
        validated = f"validated on the {n_views['val']:,} of the val scenes"
    trained = [record]
    for other in records(network.parent / SHELF).values():
        about = other["about"]
        if about["method"] != training["method"] and {**about, "method": training["method"]} == training:
            trained.append(other)
    names = [name.removeprefix("val_") for name in record["metrics"] if name.startswith("val_")]
    lines = []
    for number, one in enumerate(trained):
        epoch = f"{one['metrics']['epoch'] + 1:.0f}"
        lines.append([_label(one), "no" if number else "yes", epoch, *_validated(one, names)])
    return {
        "n_train": f"{n_views['train']:,}",
        "validated": validated,
        "network": network.name,
        "epoch": f"{record['metrics']['epoch'] + 1:.0f}",
        "epochs": config["epochs"],
        "options": _pairs({name: value for name, value in config.items() if name != "epochs"}),
        "network_table": _table(["network", "ships", "epoch"], names, lines),
    }


def _learners(network: Path) -> dict[str, str]:
    """Describe the other learners, trained besides the paper's network; empty without any."""
    from wheretolook.training.weights import read_record

    names = [name for name, method in learned().items() if method.folder != learned()[network.stem].folder]
    paths = [place / f"{name}.safetensors" for name in names for place in (network.parent, network.parent / SHELF)]
    lines = []
    options = []
    further = []
    for path in paths:
        if not path.with_suffix(".json").is_file():
            continue
        ships = path.parent == network.parent
        record = read_record(path)
        about = record["about"]
        label = _label(record)
        lines.append([label, "yes" if ships else "no", str(about["dataset"]), *_validated(record, _LEARNER_METRICS)])
        own = {name: value for name, value in about["config"].items() if name not in DECIDING}
        if ships and own:
            options.append(f"{label}: {_pairs(own)}, seed {about['config']['seed']}.")
        if about.get("also"):
            further.append(f"{label}: {', '.join(about['also'])}.")
    return {
        "learner_table": _table(["beside it", "ships", "dataset"], _LEARNER_METRICS, lines) if lines else "",
        "learner_options": " ".join(options),
        "further": " ".join(further),
    }


def _label(record: Mapping[str, Any]) -> str:
    return method_style(record["about"]["method"]).label


def _validated(record: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Return the validation metrics of a training record."""
    return [f"{record['metrics'].get(f'val_{name}', float('nan')):.4f}" for name in names]


def _table(header: list[str], metrics: Sequence[str], lines: list[list[str]]) -> str:
    return markdown_table([*header, *[name.replace("_", " ") for name in metrics]], lines)


def _fingerprints(release: Dataset, about: Mapping[str, Any]) -> str:
    from wheretolook.training.provenance import training_fingerprint

    rows = [
        ["dataset", release.fingerprint()],
        ["its train and val scenes", training_fingerprint(release)],
        [f"{about['source']}, from which it was made", about["source_fingerprint"]],
    ]
    rows += [[f"weights/{path.name}, SHA-256", sha256(path)] for path in _weights(release)]
    return markdown_table(["what", "fingerprint"], rows)


def _size_text(release: Dataset) -> str:
    parts = sizes(release.root)
    n_views = sum(len(scene.read_table()) for scene in release.scenes)
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
