"""Finds the configurations and weights that are bundled with the package.

They are in `wheretolook/shipped/` under the names that they have in the project's folder, such as `configs/demo.yaml`:
links to that folder in a checkout, copies in a wheel.
"""

from __future__ import annotations

from pathlib import Path

from wheretolook.utils.errors import ConfigError

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
