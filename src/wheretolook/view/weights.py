"""Choose the weights of each method for a map: given, adapted to the scene, trained with its dataset, or bundled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.utils.shipped import WEIGHTS, or_shipped, shipped

if TYPE_CHECKING:
    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.geometry.poses import Float


@dataclass(frozen=True)
class AvailableWeights:
    """Weights files and their origin, by the method that they belong to; the preferred method comes first."""

    files: dict[str, Path]
    origins: dict[str, str]

    @classmethod
    def of(cls, features: str, own: dict[str, Path | None]) -> AvailableWeights:
        """Collect the weights of existing files or folders by origin, then bundled ones, for a map with `features`."""
        from wheretolook.weights.resolve import weights_by_method

        available = cls({}, {})
        for origin, place in {**own, "bundled with wheretolook": shipped(WEIGHTS)}.items():
            for method, path in weights_by_method(place, features).items() if place is not None else ():
                if method not in available.files:
                    available.files[method] = path
                    available.origins[method] = origin
        return available

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


def given_weights(path: Path, features: str = "") -> AvailableWeights:
    """Collect the weights in a file or folder, and bundled ones. Raises WeightsError if they cannot be used."""
    return AvailableWeights.of(features, {"given": or_shipped(path)})


def scene_weights(files: SceneFolder, landmarks: Float, features: str = "") -> AvailableWeights:
    """Collect weights adapted to a scene with landmarks (N, 3) m, trained with its dataset, and bundled ones."""
    root = files.folder.parent
    trained = None
    if any((root / "weights").glob("*.safetensors")):
        from wheretolook.dataset.layout import Dataset
        from wheretolook.weights.resolve import resolve_weights

        trained = resolve_weights(dataset=Dataset.load(root))
        if trained is not None and not trained.is_relative_to(root):
            trained = None
    adapted = _if_adapted_to(root / "adapted" / f"{files.name}.safetensors", landmarks)
    return AvailableWeights.of(features, {"adapted to this scene": adapted, "trained with this dataset": trained})


def map_weights(model: Path, data: Path, landmarks: Float, features: str = "") -> AvailableWeights:
    """Collect weights adapted to a COLMAP model with landmarks (N, 3) m by `wheretolook adapt --map`, and bundled ones."""
    from wheretolook.mapping.config import ExistingModelConfig

    path = data / "checks" / ExistingModelConfig(model=model).scene_name / "adapted.safetensors"
    return AvailableWeights.of(features, {"adapted to this scene": _if_adapted_to(path, landmarks)})


def _if_adapted_to(path: Path, landmarks: Float) -> Path | None:
    """Return the path if the file has weights adapted to a scene with these landmarks (N, 3) m."""
    if not path.is_file():
        return None
    from safetensors import SafetensorError, safe_open

    from wheretolook.scorers.adapted.place import LEAST_SAME, share_of_place

    try:
        with safe_open(path, framework="np") as file:
            place = file.get_tensor("place")
    except (SafetensorError, OSError):
        return None
    return path if share_of_place(place, landmarks) >= LEAST_SAME else None
