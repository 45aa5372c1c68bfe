"""`wheretolook demo`: all commands from scenes to evaluate, with an estimate of the remaining time."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import ClassVar

from tqdm.auto import tqdm

from wheretolook.commands.evaluate import evaluate_methods, not_logged
from wheretolook.commands.label import Label
from wheretolook.commands.map import BuildMap
from wheretolook.commands.options import Experiment, Log, Progress, load_dataset, select_options
from wheretolook.commands.sample import Sample
from wheretolook.commands.scenes import Scenes
from wheretolook.commands.train import Train
from wheretolook.dataset.layout import STAGES, Dataset
from wheretolook.evaluation.config import SCORES_CSV, SCORES_MD, SCORES_PNG, EvaluateConfig, results_folder
from wheretolook.scorers.registry import methods_named, scorers
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.scorers.weights import resolve_weights
from wheretolook.tracking import check_store, ui_command
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import ArtifactCache, cache_key, fingerprint
from wheretolook.utils.package import VERSION, reports

SECONDS = {"scenes": 5.0, "map": 15.0, "sample": 1.0, "label": 75.0, "train": 25.0, "evaluate": 6.0}
"""Rough cost of a stage on two cores (the first four for each scene), from which the share done is estimated."""

OVERVIEW = "overview.png"


@dataclass(frozen=True, kw_only=True)
class Demo(Experiment):
    """Run all commands from scenes to evaluate on a small dataset, and draw the scores.

    Without --config, on configs/demo.yaml: three apartments to train on and one to test on. Results that exist, made by
    the same settings, are reused.

    Examples:
      wheretolook demo
      wheretolook demo --name small --scenes.train 2

    Args:
        train: what is trained on the labels.
        evaluate: which methods are compared.
    """

    CONFIG: ClassVar = "demo"
    SHORT: ClassVar = {"engine": "label.engine"}

    train: TrainConfig = field(default_factory=TrainConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)

    def run(self) -> None:
        """Run every step with a progress bar, and print where the results are."""
        config = self.scenes
        n_scenes = config.train + config.val + config.test + len(config.meshes)
        cost = {name: seconds * (n_scenes if name in STAGES else 1) for name, seconds in SECONDS.items()}
        steps: dict[str, Callable[..., object]] = {
            "scenes": select_options(Scenes, self).run,
            "map": select_options(BuildMap, self).run,
            "sample": select_options(Sample, self).run,
            "label": select_options(Label, self).run,
            "train": select_options(Train, self).run,
            "evaluate": partial(compare, self),
        }
        if config.train == 0 and not any(mesh.split == "train" for mesh in config.meshes):
            del steps["train"], cost["train"]
            self._check_weights()
        print(f"Data go to {self.root.resolve()}, runs to {self.tracking.root}.")
        check_store(self.tracking)
        layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed} elapsed, about {remaining} remain"
        with tqdm(total=sum(cost.values()), desc="demo", bar_format=layout, smoothing=0) as bar:
            for number, (name, step) in enumerate(steps.items(), 1):
                bar.set_description_str(f"demo {number}/{len(steps)} {name}")
                step(log=partial(_write, name), progress=partial(_update, bar, SECONDS[name]))
            weights = self.evaluate.weights
            own = self.root / "weights"
            drawn = (self.root / "results" / OVERVIEW).is_file()  # `compare` removes an outdated one
            if not drawn and (weights or any(own.glob("*.safetensors"))):
                for draw in reports("demo"):
                    draw(self, weights[-1] if weights else own)
            bar.set_description_str("demo")
        _print_results(self)

    def _check_weights(self) -> None:
        """Raise ConfigError if weights must be named, as no scene is there to train on, and are not."""
        chosen = methods_named(self.evaluate.methods, scorers())
        if any(method.weights for method in chosen) and not self.evaluate.weights:
            fix = "Name weights in evaluate.weights, or leave trained methods out of evaluate.methods."
            raise ConfigError("no scene to train on, and no weights to evaluate", fix=fix)


def compare(options: Demo, log: Log, progress: Progress) -> None:
    """Evaluate with the dataset's own weights and the bundled ones, unless the results are current.

    Raises what `evaluate_methods` does.
    """
    dataset = load_dataset(options, "label")
    config = options.evaluate
    tracking = options.tracking
    results = results_folder(dataset, config)
    written = (results / SCORES_CSV, results / SCORES_MD)
    bundled = resolve_weights(features=dataset.features)
    assert bundled is not None
    files = config.weights or [*sorted((options.root / "weights").glob("*.safetensors")), bundled]
    settings = [asdict(config), asdict(options.occlusion), VERSION, tracking.root]

    def cache() -> ArtifactCache:
        content = [fingerprint(path) for path in (*files, *written) if path.is_file()]
        key = cache_key("evaluate", dataset.fingerprint(), content, settings)
        return ArtifactCache(options.root, key, manifest="compared.json")

    current = cache().is_current(written[0], tracking.root / "mlflow.db") and not not_logged(dataset).exists()
    if not current:
        from wheretolook.evaluation.scoring import own_weights

        models = list(config.weights) or [*own_weights(dataset), bundled]
        (results / OVERVIEW).unlink(missing_ok=True)
        device = options.warp_device
        evaluate_methods(dataset, config, tracking, models, device=device, occlusion=options.occlusion, show=False)
        cache().store()
    log(f"{'reusing' if current else 'all methods compared ->'} {written[1]}")
    progress(1)


def _write(step: str, text: str) -> None:
    tqdm.write(f"[{step}] {text}")


def _update(bar: tqdm, seconds: float, work: float) -> None:
    bar.update(seconds * work)


def _print_results(options: Demo) -> None:
    """Print which method chose best, and where the picture, tables and runs are."""
    from wheretolook.evaluation.results import best_in_words, read_scores

    results = results_folder(Dataset.load(options.root), options.evaluate)
    picture = options.root / "results" / OVERVIEW
    print(f"""
{textwrap.fill(best_in_words(read_scores(results / SCORES_CSV)), 100)}

  picture       {picture if picture.is_file() else results / SCORES_PNG}
  tables        {results / SCORES_MD}
  runs          {ui_command(options.tracking)}
  your own map  wheretolook select --map SPARSE --at FILE --out FILE
""")
