"""Optional packages, and the extra of this distribution that installs each."""

from __future__ import annotations

import sys
from importlib.util import find_spec

from wheretolook.utils.errors import ConfigError

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
