"""Choose the weights of each method for a map: given, adapted to the scene, trained with its dataset, or bundled."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.utils.shipped import WEIGHTS, shipped

if TYPE_CHECKING:
    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.mapping.landmarks import Landmarks


class AvailableWeights:
    """Weights files and their origin, by the method that they belong to; the preferred method comes first.

    Made from existing files or folders by origin, followed by the bundled weights, for a map with `features`. Raises
    WeightsError if they cannot be used.
    """

    def __init__(self, features: str, own: Mapping[str, Path | None]) -> None:
        from wheretolook.scorers.weights import weights_by_method

        self.files: dict[str, Path] = {}
        self.origins: dict[str, str] = {}
        for origin, place in {**own, "bundled with wheretolook": shipped(WEIGHTS)}.items():
            for method, path in weights_by_method(place, features).items() if place is not None else ():
                if method not in self.files:
                    self.files[method] = path
                    self.origins[method] = origin

    def describe(self, method: str) -> str:
        """Describe the weights that a method scores with; empty for a method without weights."""
        from wheretolook.scorers.registry import scorers

        kind = scorers()[method].weights
        return f"weights {self.origins[kind]}: {self.files[kind].name}" if kind in self.files else ""

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that can score with these weights or without any, the preferred one first."""
        from wheretolook.scorers.registry import scorers

        usable = [
            name
            for name, method in scorers().items()
            if method.group != "probes" and name != "random" and (not method.weights or method.weights in self.files)
        ]
        first = next(iter(self.files), "")
        return tuple(sorted(usable, key=lambda name: (scorers()[name].weights != first, name != first)))


def scene_weights(files: SceneFolder, landmarks: Landmarks) -> dict[str, Path | None]:
    """Find weights adapted to a scene and those trained with its dataset."""
    root = files.folder.parent
    trained = None
    if any((root / "weights").glob("*.safetensors")):
        from wheretolook.dataset.layout import Dataset
        from wheretolook.scorers.weights import resolve_weights

        trained = resolve_weights(dataset=Dataset.load(root))
        if trained is not None and not trained.is_relative_to(root):
            trained = None
    adapted = _if_adapted_to(root / "adapted" / f"{files.name}.safetensors", landmarks)
    return {"adapted to this scene": adapted, "trained with this dataset": trained}


def map_weights(model: Path, data: Path, landmarks: Landmarks) -> dict[str, Path | None]:
    """Find weights adapted to a COLMAP model by `wheretolook adapt --map`."""
    from wheretolook.mapping.config import place_name

    path = data / "checks" / place_name(model) / "adapted.safetensors"
    return {"adapted to this scene": _if_adapted_to(path, landmarks)}


def _if_adapted_to(path: Path, landmarks: Landmarks) -> Path | None:
    """Return the path if the file has weights adapted to a scene with these landmarks."""
    if not path.is_file():
        return None
    from safetensors import SafetensorError, safe_open

    from wheretolook.scorers.adapted.place import MIN_SHARE, share_of_place

    try:
        with safe_open(path, framework="np") as file:
            place = file.get_tensor("place")
    except (SafetensorError, OSError):
        return None
    return path if share_of_place(place, landmarks.points) >= MIN_SHARE else None
