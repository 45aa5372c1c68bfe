"""The installed package: its version, bundled files, optional packages, and reports of other packages."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from wheretolook.utils.errors import ConfigError

VERSION = "0.3.0"
WEIGHTS = "data/release/weights"  # folder of the bundled weights


def shipped(name: str | Path = "") -> Path:
    """Return the path of a bundled file or folder, or of the folder of all. Raises ConfigError if there is none."""
    root = Path(__file__).parents[1] / "shipped"
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


EXTRAS = {
    "cv2": "photographs",
    "open3d": "depth",
    "ompl": "plan",
    "pyarrow": "plan",
    "mlflow": "plan",
    "lightning": "train",
    "torchmetrics": "train",
    "sklearn": "train",
    "kornia": "learned",
    "lightgbm": "paper",
    "jinja2": "paper",
    "ray": "ray",
    "rerun": "view",
    "rosbags": "rosbag",
}
"""Extras by module; of several that install it, the smallest."""


def missing_package(module: str) -> ConfigError:
    """Return the error for an optional module that is not installed."""
    fix = f"pip install 'wheretolook[{EXTRAS[module]}]'."
    if module == "ompl" and sys.platform == "win32":
        fix = "It has no wheels for Windows: plan on Linux or macOS, or install OMPL with its Python bindings."
    return ConfigError(f"this needs the package {module}, which is not installed", fix=fix)


def require(module: str) -> None:
    """Raise ConfigError, with the command that installs it, if an optional module is missing."""
    if find_spec(module) is None:
        raise missing_package(module)


def reports(stage: str) -> list[Callable[..., Any]]:
    """Return the functions of installed packages that report on a stage: entry points of this name.

    `label`, `evaluate`, `look_sets`, `plan`, `demo` and `film` are called by the commands where they import this function.
    """
    from importlib.metadata import entry_points

    return [entry.load() for entry in entry_points(group="wheretolook.reports", name=stage)]
