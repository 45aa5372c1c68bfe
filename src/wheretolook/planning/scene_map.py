"""The viewpoint map of a scene of a dataset."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from wheretolook.dataset.folders import RELEASE, Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import ViewLattice
from wheretolook.learning.provenance import was_trained_on
from wheretolook.learning.weights import method_of_weights, read_record, read_training, read_weights
from wheretolook.methods.field_of_view import same_field_of_view
from wheretolook.methods.registry import load_scorer, make_scorer, members, scorers
from wheretolook.planning.map_building import build_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.utils.errors import ConfigError, WeightsError


def scene_viewpoint_map(
    scene: Scene, views: ViewLattice, method: str = "", weights: Path | None = None
) -> ViewpointMap:
    """Build the viewpoint map of a scene, with progress bars.

    Args:
        scene: where a camera can be, what it sees, and where kernels run.
        views: voxels and directions.
        method: that scores; empty for that of the weights, or bins without.
        weights: of a method that has learnt.

    Raises:
        SceneError: no voxel is free. MapError: there are no landmarks.
        ConfigError: no such method, or it needs weights. WeightsError: the weights cannot be used.
    """
    grid, free = scene.free_voxels(views, scene.space)
    if weights is not None and not method:
        scorer = load_scorer(weights, scene.localization_map)
    else:
        scorer = make_scorer(method or "bins", scene.localization_map, weights=weights)
    return build_viewpoint_map(scorer, grid, free, views.axes(), views.lattice, f"viewpoint map {scene.name}")


def weights_for(
    method: str, dataset: Dataset, given: Path | None = None, say: Callable[[str], None] = print
) -> Path | None:
    """The weights that a method scores with: those given if they are of its kind, or else the best there are.

    Args:
        method: its name; empty for whatever the weights are of.
        dataset: see `default_weights`.
        given: a file of weights.
        say: told of files that cannot be used, and why.

    Returns:
        None for a method that has learnt nothing, or if there are none.

    Raises:
        WeightsError: the file given is missing or damaged.
    """
    kinds = {known.weights for known in members(method, scorers())}
    if "" in kinds or (method and not kinds):
        return None
    if given is not None and (not method or method_of_weights(given) in kinds):
        return given
    return default_weights(dataset, say, kinds)


def default_weights(dataset: Dataset, say: Callable[[str], None] = print, kinds: Collection[str] = ()) -> Path | None:
    """The best weights of a dataset, or else of the release beside it, that serve its camera's field of view.

    Args:
        dataset: whose `weights` folder is looked into first.
        say: told of files that cannot be used, and why.
        kinds: names of methods of which they may be; empty for all that score views by themselves.
    """
    kinds = kinds or {name for name, method in scorers().items() if method.weights == name}
    for root in (dataset.root, dataset.root.parent / RELEASE):
        fitting: dict[Path, float] = {}
        for path in sorted((root / "weights").glob("*.safetensors")):
            try:
                if method_of_weights(path) not in kinds:
                    continue
                header, training = read_weights(path)[1], read_training(path)
                trained = PinholeCamera(**header["camera"])
                precision = float(read_record(path)["metrics"]["val_average_precision"])
            except (WeightsError, ConfigError, KeyError, TypeError, ValueError) as error:
                say(f"not used: {path}: {error}")
                continue
            if root == dataset.root and not was_trained_on(dataset, training):
                say(f"not used: {path}: trained on other data than the dataset now holds")
            elif same_field_of_view(trained, dataset.camera):
                fitting[path] = precision
        if fitting:
            return max(fitting, key=lambda path: fitting[path])
    return None
