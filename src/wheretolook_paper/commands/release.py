"""`wheretolook release`: a compact copy of a labelled dataset, and its card."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

from wheretolook.commands.evaluate import Evaluate
from wheretolook.commands.options import Experiment, Log, Progress, ignore_progress, load_dataset, select_options
from wheretolook.dataset.config import RELEASE_FILE
from wheretolook.dataset.dataset_lock import changing, reading, reads_dataset
from wheretolook.evaluation.config import SCORES_CSV, VARIANTS_CSV, EvaluateConfig
from wheretolook.tracking import check_store
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import check_folder_name, copy_file, safe_child, write_text

if TYPE_CHECKING:
    from wheretolook.dataset.layout import Dataset


@dataclass(frozen=True, kw_only=True)
class Release(Experiment):
    """Make a compact copy, data/release; given that copy and weights trained on it, evaluate and write its card.

    Examples:
      wheretolook release --config configs/release.yaml

    Args:
        release_name: name of the copy and its folder.
        evaluate: how the weights are evaluated.
    """

    SHORT: ClassVar = {"engine": "label.engine"}

    release_name: str = "release"
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_folder_name("a release's name", self.release_name)
        root = safe_child(self.data, self.release_name, "a release's name")
        if root.resolve() == self.root.resolve() and not (root / RELEASE_FILE).is_file():
            fix = "Give --release_name another name: the copy is a dataset of its own."
            problem = "the release has the name of the dataset that it is a copy of"
            raise ConfigError(problem, path=root, value=self.release_name, fix=fix)

    @reads_dataset("release")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Dataset:
        """Publish a labelled dataset: a compact copy of it, `<data>/<release_name>/`, and in the end its card.

        For any dataset but a release this makes the copy. For the copy itself, once networks are trained on it, it
        chooses the weights that ship, evaluates them and writes the card. Either can be repeated.

        Raises:
            WeightsError: there are no weights, or they do not fit the release.
            StorageError: it is not smaller than 16 MB.
            ConfigError: the copy's folder holds another dataset, or is the dataset's own.
            InUseError: another command changes the dataset, or works on the copy.
        """
        from wheretolook_paper.release import copy as releases

        dataset = load_dataset(self, "label")
        if releases.is_release(dataset):
            with reading(dataset.root, "release", "card"):
                return _finish(self, dataset, log, progress)
        root = self.data / self.release_name
        with changing(root, "release"):
            copy = releases.copy_dataset(dataset, root, release_settings(self))
            for scene, source in zip(copy.scenes, dataset.scenes, strict=True):
                key = source.stage_cache("label").stored_key
                assert key is not None  # `load_dataset` has checked it
                scene.stage_cache("label", key).store()
        log(f"{len(copy.scenes)} scenes -> {copy.root}: {releases.size_text(releases.sizes(copy.root, weights=False))}")
        log("next: train on it, then `wheretolook release` with its own configuration")
        return copy


def _finish(options: Release, dataset: Dataset, log: Log, progress: Progress) -> Dataset:
    """Choose the weights that ship with a release, evaluate them, and write its card."""
    from wheretolook_paper.release import copy as releases
    from wheretolook_paper.release.card import release_cards
    from wheretolook_paper.release.training_histories import keep_histories

    check_store(options.tracking)
    # on the CPU, so that machines without a GPU get the same scores
    config = replace(options.evaluate, weights=())
    on_cpu = replace(select_options(Evaluate, options), device="cpu", evaluate=config)
    results = dataset.root / "results"
    choice = releases.choose_weights_to_ship(dataset)
    if choice.shelved:  # all that were trained, before only the best remain
        methods = tuple(method.name for method in releases.trained_weights(dataset).values())
        replace(on_cpu, evaluate=replace(config, methods=methods, reference="")).run(log)
        copy_file(results / SCORES_CSV, results / VARIANTS_CSV)
    releases.ship_weights(choice)
    compared = ", ".join(f"{name} {value:.4f}" for name, value in choice.precision.items())
    log(f"validation average precision: {compared}")
    log(f"the paper's network that ships, in half precision: {choice.network}; the best of all: {choice.best}")
    keep_histories(dataset, options.tracking)
    releases.sizes(dataset.root)  # an error if too large, before the evaluation
    on_cpu.run(log, progress)
    for path, card in release_cards(dataset, release_settings(Experiment())).items():
        write_text(path, card)
        log(f"the card -> {path}")
    log(releases.size_text(releases.sizes(dataset.root)))
    return dataset


def release_settings(options: Experiment) -> dict[str, Any]:
    """Return the settings that decide the contents of a dataset, as JSON values, with meshes by name instead of path."""
    meshes = [{"name": mesh.scene_name, "split": mesh.split, "up": mesh.up} for mesh in options.scenes.meshes]
    groups = {
        "scenes": options.scenes,
        "mapping": options.mapping,
        "occlusion": options.occlusion,
        "sample": options.sample,
    }
    settings = {name: _record(group) for name, group in groups.items()}
    settings = {"camera": options.camera.camera.record(), **settings}
    settings["scenes"] |= {"meshes": meshes, "free_space": asdict(options.free_space)}
    settings["scenes"]["mapped_space"] = asdict(options.mapped_space)
    settings["mapping"] |= {"camera": options.mapping.camera and asdict(options.mapping.camera)}
    settings["mapping"] |= {"draw_camera": options.mapping.draw_camera, "extractor": options.extractor.record()}
    settings["label"] = {"localizer": options.label.localizer.record()}
    for name in ("appearance", "changes"):
        if getattr(options.label, name):
            settings["label"][name] = getattr(options.label, name)
    return dict(json.loads(json.dumps(settings, default=str)))


def _record(config: Any) -> dict[str, Any]:
    """Return a group of options with the constants that it records."""
    return dict(config.record() if hasattr(config, "record") else asdict(config))
