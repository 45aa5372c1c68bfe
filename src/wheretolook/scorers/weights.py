"""Find the weights file of a method, and load the learned scorer of a map."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.dataset.config import RELEASE
from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.camera import camera_of_record
from wheretolook.scorers.base import Scorer, same_field_of_view
from wheretolook.scorers.registry import SUBSTITUTES, BuildOptions, build_scorer, check_method, members, scorers
from wheretolook.training.provenance import was_trained_on
from wheretolook.training.weights import method_of_weights, preference, read_training, read_weights
from wheretolook.utils.errors import ConfigError, WeightsError
from wheretolook.utils.package import WEIGHTS, or_shipped, shipped

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap


def resolve_weights(
    method: str = "",
    path: str | Path | None = None,
    features: str = "",
    dataset: Dataset | None = None,
    log: Callable[[str], None] = print,
) -> Path | None:
    """Return the weights file that a method or a family scores with; None for a method without weights.

    An empty `method` stands for any that scores views by itself. A `path` is a file, or a folder or name on the hub of
    which the best file is taken (`find_weights`). Without one the candidates are the files in the `dataset`'s folder,
    then in the release next to it, then the bundled ones. In a folder, files trained on the map's `features` come
    first.

    With a `dataset`, `features` default to those of its maps, a given file of another method is passed over, files that
    do not fit (unreadable, of another field of view, or trained on data that has changed) are reported to `log`, and
    None is returned if none fits. Without one, a missing file raises.

    Raises:
        ConfigError: there is no such method.
        WeightsError: the path does not exist, is not readable, or holds no weights of the method.
    """
    kinds = (
        {known.weights for known in members(method, scorers()) or [check_method(method)]} if method else _self_scoring()
    )
    if "" in kinds:
        return None
    if path is None and dataset is not None:
        return _best_for_dataset(dataset, kinds, log)
    place = shipped(WEIGHTS) if path is None else find_weights(path)
    if not place.is_dir():
        kind = method_of_weights(place)
        if kind in kinds:
            return place
        if dataset is not None and method:
            return _best_for_dataset(dataset, kinds, log)
        fix = f"Give weights of {' or '.join(sorted(kinds))}, or train them."
        raise WeightsError(f"these weights are not of {method or 'a scorer'}", path=place, value=kind, fix=fix)
    for folder in _folders(place, features or ("" if dataset is None else dataset.features)):
        paths = [file for file in sorted(folder.glob("*.safetensors")) if method_of_weights(file) in kinds]
        if paths:
            return paths[0] if len(paths) == 1 else max(paths, key=preference)
    fix = "Give a file of weights, name another method, or train it."
    raise WeightsError(f"there are no weights of {method or 'a scorer'} here", path=place, fix=fix)


def weights_by_method(path: str | Path, features: str = "") -> dict[str, Path]:
    """Return one weights file for each method in a folder, or of one file, by the method's name; the best comes first.

    In a folder, files trained on the map's `features` come first; unreadable ones are left out. Raises as
    `resolve_weights`.
    """
    path = find_weights(path)
    best = resolve_weights(path=path, features=features)
    assert best is not None
    files = {method_of_weights(best): best}
    for folder in _folders(path, features) if path.is_dir() else ():
        for file in sorted(folder.glob("*.safetensors")):
            with suppress(WeightsError):
                files.setdefault(method_of_weights(file), file)
    return files


def find_weights(path: str | Path) -> Path:
    """Return the path of local or bundled weights, or else of those of a name, "owner/name", on the Hugging Face hub.

    Weights in the hub's cache are taken from there; others, also those of an incomplete download, are downloaded. Raises
    WeightsError if that fails.
    """
    place = or_shipped(path)
    if place.exists() or place.suffix == ".safetensors" or len(place.parts) != 2:
        return place
    home = Path(os.environ.get("HF_HOME", "~/.cache/huggingface")).expanduser()
    hub = Path(os.environ.get("HF_HUB_CACHE", home / "hub")).expanduser()
    cached = hub / "--".join(("models", *place.parts))
    try:
        if (cached / "refs/main").is_file():
            snapshot = cached / "snapshots" / (cached / "refs/main").read_text()
            if any(snapshot.glob("*.safetensors")):
                return snapshot
        from huggingface_hub import snapshot_download

        return Path(snapshot_download(place.as_posix()))
    except (ImportError, OSError, ValueError) as error:
        fix = "Correct the path, or for weights on the hub: pip install 'wheretolook[hub]'."
        raise WeightsError(f"there are no such weights, also not on the hub: {error}", path=place, fix=fix) from error


def load_scorer(localization_map: LocalizationMap, weights: str | Path | None = None, anywhere: bool = False) -> Scorer:
    """Return the learned scorer of a map: `load_scorer(localization_map).score(cam_from_world)`.

    `weights` are a file that the train command wrote, whose header names the method, or a folder of such files, of
    which `resolve_weights` takes the best, or a name on the Hugging Face hub, "owner/name"; None for the bundled ones.
    A path such as `data/release/weights` names bundled files from any working directory. With `anywhere`, weights
    adapted to one scene score in another.

    Raises:
        WeightsError: the weights are unusable, or adapted to another scene.
        CameraError: they were trained for another field of view than the map's camera.
        MapError: the map lacks what the method needs.
    """
    path = resolve_weights(path=weights, features=localization_map.landmarks.features)
    assert path is not None
    method = check_method(method_of_weights(path))
    return build_scorer(method, localization_map, BuildOptions(weights=path, anywhere=anywhere))


def _self_scoring() -> set[str]:
    """Return the names of the methods that score views with their own weights."""
    return {name for name, method in scorers().items() if method.weights == name}


def _folders(folder: Path, features: str) -> Iterator[Path]:
    """Yield the subfolder with weights trained on these features, or on the nearest that has some, then the folder."""
    for name in filter(None, (features, SUBSTITUTES.get(features))):
        if next((folder / name).glob("*.safetensors"), None) is not None:
            yield folder / name
            break
    yield folder


def _best_for_dataset(dataset: Dataset, kinds: set[str], log: Callable[[str], None]) -> Path | None:
    """Return the preferred file that serves a dataset's cameras, from the first folder that has any."""
    own = dataset.root / "weights"
    others = (dataset.root.parent / RELEASE / "weights", shipped(WEIGHTS))
    for folder in dict.fromkeys((own, *(next(_folders(other, dataset.features)) for other in others), *others)):
        fitting: dict[Path, tuple[bool, float]] = {}
        for path in sorted(folder.glob("*.safetensors")):
            try:
                if (kind := method_of_weights(path)) not in kinds:
                    continue
                header = read_weights(path)[1]
                trained = camera_of_record(header["camera"]) if scorers()[kind].one_camera else None
                preferred = preference(path)
            except (WeightsError, ConfigError, KeyError, TypeError, ValueError) as error:
                log(f"not used: {path}: {error}")
                continue
            if folder == own and not was_trained_on(dataset, read_training(path)):
                log(f"not used: {path}: trained on other data than the dataset now holds")
            elif trained is None or all(same_field_of_view(trained, camera) for camera in dataset.cameras):
                fitting[path] = preferred
        if fitting:
            return max(fitting, key=lambda path: fitting[path])
    return None
