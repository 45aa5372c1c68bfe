"""Export what a robot needs to localize: descriptors, and copies of the modules that do it without PyTorch."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import wheretolook
from wheretolook.features.sift import SIFT
from wheretolook.geometry.poses import Float
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import atomic_write, copy_file, write_text

PACKAGE = "wheretolook_localization"  # of the copies, so that an installed wheretolook does not replace them
FIRST = "wheretolook.robot.image_sequence", "wheretolook.planning.view_sequence"
ROOT = Path(wheretolook.__file__).parent


def export_localizer(landmarks: Landmarks, ids: NDArray[np.int64], mean_scores: Float, out: Path) -> None:
    """Write the localizer into a robot's folder: the package `PACKAGE`, descriptors.npy of the landmarks with ids (N,),
    and mean_scores.npy, of `wheretolook.looks.next_look.mean_scores_by_pitch`.

    Raises MapError unless these landmarks have SIFT descriptors.
    """
    if landmarks.descriptors is None or landmarks.features != SIFT.name:
        fix = "Give --database with SIFT descriptors, or leave --localize out."
        raise MapError("a robot localizes by SIFT descriptors", value=landmarks.features or "none", fix=fix)
    known = np.isin(landmarks.ids, ids)
    if known.sum() != len(ids):
        raise MapError(
            "the descriptors are of other landmarks", value=f"{known.sum()} of {len(ids)}", fix="Give --database."
        )
    for name, array in (("descriptors", landmarks.descriptors[known]), ("mean_scores", mean_scores)):
        with atomic_write(out / f"{name}.npy") as partial, partial.open("wb") as file:
            np.save(file, array)
    folder = out / PACKAGE
    for name in _modules():
        path = _path(name)
        assert path is not None
        text = path.read_text(encoding="utf-8").replace("from wheretolook.", f"from {PACKAGE}.")
        write_text(folder / path.relative_to(ROOT), text)
    exported = {"image_sequence": "ImageSequence", "localizer": "RobotLocalizer"}
    lines = [f"from {PACKAGE}.robot.{module} import {name}\n" for module, name in exported.items()]
    write_text(folder / "__init__.py", "".join(lines))
    copy_file(ROOT / "localization" / "confidence.json", folder / "localization" / "confidence.json")


def _path(module: str) -> Path | None:
    """Return the file of a module of this package, None for other names."""
    path = ROOT.joinpath(*module.split(".")[1:]).with_suffix(".py")
    return path if path.is_file() else None


def _modules() -> set[str]:
    """Return the names of the modules to copy: `FIRST`, and what they import."""
    found: set[str] = set()
    left = [*FIRST]
    while left:
        name = left.pop()
        path = _path(name)
        if name not in found and path is not None:
            found.add(name)
            left.extend(_imports(ast.parse(path.read_text(encoding="utf-8"))))
    return found


def _imports(node: ast.AST) -> Iterator[str]:
    """Yield the modules that code imports, apart from those for types only."""
    if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("wheretolook."):
        yield str(node.module)
    if not (isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
        for child in ast.iter_child_nodes(node):
            yield from _imports(child)
