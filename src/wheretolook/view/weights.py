"""Which weights score here: those given, or else the place's own, or else those that ship."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.utils.shipped import WEIGHTS, or_shipped, shipped

if TYPE_CHECKING:
    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.geometry.poses import Float

GIVEN = "given"
ADAPTED = "adapted to this place"
TRAINED = "trained with this dataset"
SHIPPED = "that ship"


@dataclass(frozen=True)
class KnownWeights:
    """Files of weights by the kind they are of, and where each comes from, for people."""

    files: dict[str, Path]
    sources: dict[str, str]

    def told(self, method: str) -> str:
        """With which weights a method scores; empty if it has learnt nothing."""
        from wheretolook.scorers.registry import scorers

        kind = scorers()[method].weights
        return f"weights {self.sources[kind]}: {self.files[kind].name}" if kind in self.files else ""

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods that can score with these or without any, that of the first file first."""
        from wheretolook.scorers.registry import scorers

        able = [
            name
            for name, known in scorers().items()
            if known.group != "probes" and name != "random" and (not known.weights or known.weights in self.files)
        ]
        first = next(iter(self.files), "")
        return tuple(sorted(able, key=lambda name: (scorers()[name].weights != first, name != first)))


def given_weights(path: Path, features: str = "") -> KnownWeights:
    """A file, or a folder of them, before those that ship, for a map by these features.

    Raises a WeightsError if they cannot be used.
    """
    return _known([(or_shipped(path), GIVEN)], features)


def scene_weights(files: SceneFolder, landmarks: Float, features: str = "") -> KnownWeights:
    """Those of a scene of a dataset: adapted to it, or else those its dataset has trained (`resolve_weights`).

    `landmarks` (N, 3) m are those of the scene's map, by these features.
    """
    own = []
    root = files.folder.parent
    if _are_of(adapted := root / "adapted" / f"{files.name}.safetensors", landmarks):
        own.append((adapted, ADAPTED))
    if any((root / "weights").glob("*.safetensors")):
        from wheretolook.dataset.layout import Dataset
        from wheretolook.weights.resolve import resolve_weights

        trained = resolve_weights(dataset=Dataset.load(root))
        if trained is not None and trained.is_relative_to(root):
            own.append((trained, TRAINED))
    return _known(own, features)


def map_weights(model: Path, data: Path, landmarks: Float, features: str = "") -> KnownWeights:
    """Those that `wheretolook adapt --map` has adapted to a COLMAP model with landmarks (N, 3) m, if it has."""
    from wheretolook.mapping.config import ExistingModelConfig

    adapted = data / "checks" / ExistingModelConfig(model=model).scene_name / "adapted.safetensors"
    return _known([(adapted, ADAPTED)] if _are_of(adapted, landmarks) else [], features)


def _known(own: Iterable[tuple[Path, str]], features: str) -> KnownWeights:
    from wheretolook.weights.resolve import weights_by_method

    known = KnownWeights({}, {})
    for place, source in [*own, (shipped(WEIGHTS), SHIPPED)]:
        for kind, path in weights_by_method(place, features).items():
            if kind not in known.files:
                known.files[kind] = path
                known.sources[kind] = source
    return known


def _are_of(path: Path, landmarks: Float) -> bool:
    """Whether there are weights adapted to a place, and landmarks (N, 3) m are of it."""
    if not path.is_file():
        return False
    from safetensors import SafetensorError, safe_open

    from wheretolook.scorers.adapted.place import LEAST_SAME, share_of_place

    try:
        with safe_open(path, framework="np") as file:
            place = file.get_tensor("place")
    except (SafetensorError, OSError):
        return False
    return share_of_place(place, landmarks) >= LEAST_SAME
