"""Files that ship with the package: configurations, weights, and models fitted to data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError, WeightsError
from wheretolook.utils.files import read_json_object

WEIGHTS = "data/release/weights"  # folder of the bundled weights


def shipped(name: str | Path = "") -> Path:
    """Return the path of a bundled file or folder, or of the folder of all. Raises ConfigError if there is none."""
    from importlib.resources import files

    root = Path(str(files("wheretolook"))) / "shipped"
    if not (root / name).exists():
        problem = "this file is not bundled with the package" if name else "the bundled files are missing"
        raise ConfigError(problem, path=root / name, fix="Correct the name, or install the package again.")
    return root / name


def or_shipped(path: str | Path) -> Path:
    """Return the path, or if nothing exists there, the bundled file of this name, if there is one.

    So `configs/demo.yaml` and `data/release/weights/set.safetensors` can be given in any folder.
    """
    path = Path(path)
    if path.exists() or path.is_absolute() or ".." in path.parts:
        return path
    try:
        return shipped(path)
    except ConfigError:
        return path


def shipped_configs() -> list[str]:
    """Names of the bundled configurations, such as `configs/demo.yaml`."""
    return [f"configs/{path.name}" for path in sorted(shipped("configs").glob("*.yaml"))]


@dataclass(frozen=True)
class LogisticRegression:
    """Base class: a subclass names its features, what it predicts (`about`) and its bundled file."""

    names: ClassVar[tuple[str, ...]]
    about: ClassVar[str]
    file: ClassVar[Path]

    weights: tuple[float, ...]
    bias: float

    @classmethod
    @cache
    def bundled(cls) -> Self:
        """Return the bundled model, fitted on validation scenes."""
        return cls.load(cls.file)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a JSON file of weights by name and a bias. Raises a WeightsError if it is damaged."""
        try:
            stored = read_json_object(path)
            model = cls(tuple(float(stored["weights"][name]) for name in cls.names), float(stored["bias"]))
            if not np.isfinite([*model.weights, model.bias]).all():
                raise ValueError("a weight is not finite")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WeightsError(f"a damaged file of {cls.about}: {error}", path=path, fix="Fit it again.") from error
        return model

    def predict_proba(self, features: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return probabilities (...,) for feature vectors (..., K) in the order of `names`."""
        return np.asarray(1 / (1 + np.exp(-np.clip(features @ np.asarray(self.weights) + self.bias, -60, 60))))
