"""The card of a release, in Markdown: what it holds, how it was made and how well it does, from the files there."""

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
"""In `results/`: scores on other datasets, as `scores.csv` with the columns `dataset` and `weights_sha256` (of the
shipped weights at that time; rows with others are not shown), and where those datasets come from."""

_HOW_TO_USE = """\
```python
from pathlib import Path

from wheretolook import load_scorer
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import poses

dataset = Dataset.load(Path("{root}"))
scene = dataset.split("test")[0]
scorer = load_scorer("{root}/weights", scene.localization_map(dataset.camera))
scores = scorer.score(poses(scene.read_table()))  # one for each viewpoint, in [0, 1]
```"""

_TABLES = """\
Each `<scene>/viewpoints.parquet` is a table for `pandas.read_parquet`, a row a viewpoint: `viewpoint_id`, \
`location_id`, `direction_id`; the rotation cam_from_world as a quaternion `qw qx qy qz`, and the camera's centre in \
the world, `x_m y_m z_m` (the translation is -R c; `wheretolook.dataset.viewpoint_table.read_table` gives it as `tx ty tz` \
instead); `n_visible` landmarks and `visibility_rank` among the directions of the location; `status` (localized, \
too_few_matches, no_pose), `error_m`, `error_deg`, `n_inliers`. World in metres, z up; camera x right, y down, z \
forward. `map/landmarks.npz` holds the landmarks (`wheretolook.mapping.landmarks.Landmarks`), `occlusion.npz` which of \
them each location has a free line of sight to (`wheretolook.visibility.occlusion.StoredOcclusion`)."""

_CAMERAS = "`map/cameras.npz` holds the poses cam_from_world of the images that the map was made from."


def write_card(release: Dataset, defaults: Mapping[str, Any]) -> Path:
    """Write `<release>/README.md` from the weights and scores in the release's folder, and return its path.

    The same files give the same bytes. `defaults` are those of the settings in `release.json`, as JSON values: the card
    tells what differs from them.

    Raises:
        WeightsError: not exactly one of the paper's networks ships, or a record of training is missing.
        TableError: there are no scores, or no labels.
        ConfigError: the description of the release is missing or damaged.
        StorageError: the release is too large.
    """
    path = release.root / CARD
    write_text(path, release_card(release, defaults))
    return path


def release_card(release: Dataset, defaults: Mapping[str, Any]) -> str:
    """The card. Raises as `write_card`."""
    from wheretolook.training.provenance import training_fingerprint
    from wheretolook.training.weights import read_record, read_training
    from wheretolook.weights.resolve import resolve_weights

    about = read_about(release)
    weights = _network(release)
    best = resolve_weights(path=weights.parent)
    assert best is not None
    training = read_training(weights)
    record = read_record(weights)
    tables = {scene.name: scene.read_table() for scene in release.scenes}
    shares = label_summary(tables, {scene.name: scene.split for scene in release.scenes}).shares
    everything = shares.iloc[-1]
    source = about["source"]
    config = f"configs/{release.name}.yaml"
    root = f"data/{release.name}"
    changed = _difference(about["settings"], defaults)
    results = release.root / "results"
    if not (results / SCORES_CSV).is_file():
        raise TableError("there are no scores", path=results / SCORES_CSV, fix="Run the evaluate stage.")
    shipped = f"{method_style(training['method']).label}, half precision"
    if best != weights:
        shipped = f"{method_style(read_training(best)['method']).label}; and of the paper's best network, {shipped}"

    lines = [f"# {source}: tables, landmarks and weights"]
    lines += [
        f"{everything['n_views']:,} labelled viewpoints at {everything['n_locations']:,} locations of "
        f"{len(release.scenes)} scenes, the landmarks they were localized against, and the weights of the best scorer "
        f"({shipped}). Enough to train and to evaluate; meshes, COLMAP models "
        "and descriptors are left out, so nothing here can be labelled anew without making the scenes again.",
        f"```sh\nwheretolook evaluate --config {config}   # the scores below, in minutes on two cores, no GPU\n```",
        _HOW_TO_USE.format(root=root),
        "## Scores",
        f"On the test scenes, of which nothing was learnt. The weights are {_names(release)}.",
        _demoted(_score_tables(read_scores(results / SCORES_CSV), f"Localization score on {source}")),
    ]
    if (results / VARIANTS_CSV).is_file():
        lines += [
            "## Scores of all that was trained",
            "Before what ships was chosen by its validation metrics (see Training), in full precision.",
            _demoted(_score_tables(read_scores(results / VARIANTS_CSV), f"Localization score on {source}")),
        ]
    if (results / GENERALIZATION_CSV).is_file():
        others = read_scores(results / GENERALIZATION_CSV)
        others = others[others["weights_sha256"] == sha256(best)].drop(columns="weights_sha256")
        if len(others):
            lines += ["## Scores on other datasets", "Scenes neither trained nor validated on."]
        if len(others) and (results / GENERALIZATION_MD).is_file():
            lines += [(results / GENERALIZATION_MD).read_text()]
        for name, part in others.groupby("dataset", sort=False):
            lines += [_demoted(_score_tables(part.drop(columns="dataset"), f"Localization score on {name}"))]
    lines += [
        "## Data",
        _scenes_text(about["settings"]["scenes"]),
        _label_table(release, shares),
        f"Shares in % of viewpoints that localize within the limits; the label is the first, "
        f"{threshold_label(threshold_key(THRESHOLDS[0]))}. Settings of `configs/{source}.yaml` that are not the "
        "defaults (all of them are in `release.json`):",
        f"```yaml\n{yaml.safe_dump(changed, sort_keys=False, default_flow_style=None, width=110)}```",
        *_label_text(release),
        _TABLES,
        *([_CAMERAS] if all(scene.mapping_cameras.is_file() for scene in release.scenes) else []),
        "## Training",
        _training_text(weights, training, record, shares),
        _network_table(weights, training),
        *_learner_text(weights),
        "Validation metrics are those of the epoch kept, before the weights were rounded to half precision; the scores "
        "above are of the weights as they ship.",
        "## To make it again",
        "```sh\n"
        f"for stage in scenes map sample label; do wheretolook $stage --config configs/{source}.yaml; done\n"
        f"rm {root}/weights/mlp-*  # matchability stays: it has learnt from matches, which a release does not hold\n"
        f"wheretolook release --config configs/{source}.yaml   # tables and landmarks\n"
        f"wheretolook train --config {config}   # what else ships: by the options under Training\n"
        f"wheretolook release --config {config}   # chooses the weights, evaluates them, writes this page\n"
        "```",
        "## Licence",
        _licence(about["settings"]["scenes"]),
        "## Fingerprints",
        markdown_table(
            ["what", "fingerprint"],
            [
                ["dataset", release.fingerprint()],
                ["its train and val scenes", training_fingerprint(release)],
                [f"{source}, from which it was made", about["source_fingerprint"]],
                *([f"weights/{path.name}, SHA-256", sha256(path)] for path in _weights(release)),
            ],
        ),
        f"Version {about['code_version']} of the code. Sizes without text: {_size_text(release)}.",
    ]
    return "\n\n".join(part.strip("\n") for part in lines) + "\n"


def _weights(release: Dataset) -> list[Path]:
    return sorted((release.root / "weights").glob("*.safetensors"))


def _names(release: Dataset) -> str:
    names = [path.name for path in _weights(release)]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _network(release: Dataset) -> Path:
    """The weights of the paper's network."""
    networks = [name for name, method in learned().items() if method.ships == "network"]
    found = [path for path in _weights(release) if path.stem in networks]
    if len(found) != 1:
        problem = "a release ships the weights of one of the paper's networks"
        fix = f"Run `wheretolook release --config configs/{release.name}.yaml`."
        raise WeightsError(problem, path=release.root / "weights", value=[path.name for path in found], fix=fix)
    return found[0]


def _score_tables(scores: pd.DataFrame, title: str) -> str:
    return f"{score_markdown(scores, title)}\n{comparisons_markdown(scores)}"


def _demoted(markdown: str) -> str:
    """The same text, its headings two levels lower."""
    return re.sub(r"^#", "###", markdown, flags=re.MULTILINE)


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


def _difference(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """What differs from the defaults, in nested mappings too."""
    changed = {}
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            value = _difference(value, default)
            default = {}
        if value != default:
            changed[name] = value
    return changed


def _label_text(release: Dataset) -> list[str]:
    """What localized the viewpoints, if the scenes say so."""
    manifests = [_json(scene.label_manifest) for scene in release.scenes if scene.label_manifest.is_file()]
    if not manifests:
        return []
    first = manifests[0]
    versions = {}
    for package in first["versions"]:
        found = {manifest["versions"].get(package, "unknown") for manifest in manifests}
        versions[package] = " and ".join(sorted(found))
    made = f"Keypoints: {_pairs(first['extractor'])}. Localizer: {_pairs(first['localizer'])}."
    return [f"{made} Labelled with {_pairs(versions)}."]


def _training_text(weights: Path, training: Mapping[str, Any], record: Mapping[str, Any], shares: pd.DataFrame) -> str:
    config = training["config"]
    n_views = {row["split"]: row["n_views"] for row in shares[shares["scene"] == ALL].to_dict("records")}
    validated = f"{100 * config['val_fraction']:g} % of each scene's locations held out for validation"
    if "val" in n_views:
        validated = f"validated on the {n_views['val']:,} of the val scenes"
    return (
        f"From the {n_views['train']:,} viewpoints of the train scenes, {validated}. Of the "
        f"paper's networks {weights.name}, which ships, had the best validation average precision. Kept is epoch "
        f"{record['metrics']['epoch'] + 1:.0f} of at most {config['epochs']}. "
        f"Options: {_pairs({name: value for name, value in config.items() if name != 'epochs'})}."
    )


def _network_table(weights: Path, training: Mapping[str, Any]) -> str:
    """Validation metrics of the shipped network and of the others that were trained the same way."""
    from wheretolook.training.weights import read_record
    from wheretolook_paper.release.training_histories import records as read_records

    trained = [read_record(weights)]
    for record in read_records(weights.parent / SHELF).values():
        about = record["about"]
        if about["method"] != training["method"] and {**about, "method": training["method"]} == training:
            trained.append(record)
    names = [name.removeprefix("val_") for name in trained[0]["metrics"] if name.startswith("val_")]
    lines = []
    for number, record in enumerate(trained):
        epoch = f"{record['metrics']['epoch'] + 1:.0f}"
        lines.append([_label(record), "no" if number else "yes", epoch, *_validated(record, names)])
    return markdown_table(["network", "ships", "epoch", *[name.replace("_", " ") for name in names]], lines)


def _label(record: Mapping[str, Any]) -> str:
    return method_style(record["about"]["method"]).label


def _validated(record: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Validation metrics of a training record."""
    return [f"{record['metrics'].get(f'val_{name}', float('nan')):.4f}" for name in names]


def _learner_text(network: Path) -> list[str]:
    """Options and validation metrics of what was trained beside the paper's network, if anything was."""
    from wheretolook.training.weights import read_record

    names = [name for name, method in learned().items() if method.folder != learned()[network.stem].folder]
    paths = [place / f"{name}.safetensors" for name in names for place in (network.parent, network.parent / SHELF)]
    records = [(x.parent == network.parent, read_record(x)) for x in paths if x.with_suffix(".json").is_file()]
    if not records:
        return []
    lines = []
    options = []
    further = []
    for ships, record in records:
        label = _label(record)
        config = record["about"]["config"]
        learnt_from = str(record["about"]["dataset"])
        lines.append([label, "yes" if ships else "no", learnt_from, *_validated(record, _LEARNER_METRICS)])
        own = {name: x for name, x in config.items() if name not in DECIDING}
        if ships and own:
            options.append(f"{label}: {_pairs(own)}, seed {config['seed']}.")
        if record["about"].get("also"):
            further.append(f"{label}: {', '.join(record['about']['also'])}.")
    header = ["beside it", "ships", "dataset", *[name.replace("_", " ") for name in _LEARNER_METRICS]]
    return [
        "With what is known of each landmark (matchability: whether the localizer finds a landmark, from the stored "
        "matches; its metrics are of landmarks, not of viewpoints). The dataset is that of the viewpoints learnt from, "
        "whose validation views the metrics are of:",
        markdown_table(header, lines),
        "Options of those that ship. " + " ".join(options),
        *(["From further datasets beside this one: " + " ".join(further)] if further else []),
    ]


_LEARNER_METRICS = ("average_precision", "roc_auc", "bce")


def _licence(scenes: Mapping[str, Any]) -> str:
    text = "Apache-2.0, as the project: tables, landmarks and weights."
    if scenes["meshes"]:
        names = ", ".join(mesh["name"] for mesh in scenes["meshes"])
        text += f" Of scenes made by others ({names}) the licences of their meshes hold as well."
    return text


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


def _json(path: Path) -> dict[str, Any]:
    try:
        return read_json_object(path)
    except (OSError, ValueError, TypeError) as error:
        raise TableError(f"a description is missing or damaged: {error}", path=path, fix="Get it anew.") from error
