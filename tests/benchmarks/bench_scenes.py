"""What the benchmarks of labelling share: a scene, viewpoints anywhere in it, maps, and how far two labels agree."""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.viewpoint_table import SCHEMA, UNLABELLED, pose_columns
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.space.free_space import FreeSpace


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh, the file it came from, and where a camera can be in it."""

    file: Path
    mesh: TexturedMesh
    free_space: FreeSpace


def argument_parser(doc: str, views: int) -> argparse.ArgumentParser:
    """A parser with the options that every benchmark of labelling has, explained by the benchmark's docstring."""
    parser = argparse.ArgumentParser(
        description=doc.splitlines()[0], epilog=doc.partition("\n\n")[2], formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--scene", type=Path, help="folder with a mesh.glb, or a mesh file (z up); default: generate an apartment"
    )
    parser.add_argument("--views", type=int, default=views, help="number of viewpoints (default: %(default)s)")
    parser.add_argument("--map-images", type=int, default=100, help="images of the map (default: %(default)s)")
    parser.add_argument(
        "--seed", type=int, default=0, help="of the apartment, walk and viewpoints (default: %(default)s)"
    )
    parser.add_argument("--device", default="cpu", help="where images are rendered (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="write all numbers to this JSON file")
    return parser


def open_scene(source: Path | None, folder: Path, seed: int, device: str) -> Scene:
    """Read the scene, or generate an apartment into `folder`."""
    if source is None:
        from wheretolook.scenes.config import ApartmentConfig
        from wheretolook_rooms.generator import generate_apartment

        source = folder / "mesh.glb"
        save_glb(generate_apartment(ApartmentConfig(), seed, device=device), source)
    elif (source / "mesh.glb").is_file():
        source = source / "mesh.glb"
    mesh = load_mesh(source)
    return Scene(source, mesh, FreeSpace(mesh, device=device))


def viewpoints_anywhere(scene: Scene, number: int, seed: int) -> pd.DataFrame:
    """Unlabelled viewpoints at random free locations, in directions uniform on the sphere: they know of no map."""
    rng = np.random.default_rng(seed)
    found = np.empty((0, 3))
    while len(found) < number:
        candidates = rng.uniform(*scene.mesh.bounds, (20_000, 3))
        found = np.concatenate([found, candidates[scene.free_space.is_free(candidates)]])
    ids = np.arange(number)
    table = pd.DataFrame(
        {
            "viewpoint_id": ids,
            "location_id": ids,
            "direction_id": 0,
            **pose_columns(poses_looking_along(found[:number], rng.normal(size=(number, 3)))),
            "n_visible": 0,
            "visibility_rank": 0,
            "status": UNLABELLED,
            "error_m": np.float32(np.nan),
            "error_deg": np.float32(np.nan),
            "n_inliers": 0,
        }
    )
    return table[SCHEMA.names]


def agreement(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> dict[str, float | int]:
    """The 2 x 2 table of two labels, the share that is equal, and Cohen's kappa (1960): 1 is perfect, 0 is chance."""
    both = int((first & second).sum())
    neither = int((~first & ~second).sum())
    equal = (both + neither) / len(first)
    p = first.mean()
    q = second.mean()
    chance = p * q + (1 - p) * (1 - q)
    return {
        "both": both,
        "only_first": int((first & ~second).sum()),
        "only_second": int((~first & second).sum()),
        "neither": neither,
        "equal": equal,
        "kappa": float((equal - chance) / (1 - chance)) if chance < 1 else 1.0,
    }


def spread(values: Sequence[float] | NDArray[np.floating[Any]]) -> dict[str, float]:
    """Median, 10th and 90th percentile of what is finite; NaN if nothing is."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if len(finite) == 0:
        return dict.fromkeys(("median", "p10", "p90"), float("nan"))
    return dict(zip(("median", "p10", "p90"), np.quantile(finite, (0.5, 0.1, 0.9)).tolist(), strict=True))


def format_spread(values: dict[str, float], digits: int = 1, factor: float = 1.0) -> str:
    """`spread` as text: median (p10 to p90)."""
    median, low, high = (f"{factor * values[name]:,.{digits}f}" for name in ("median", "p10", "p90"))
    return f"{median} ({low} to {high})"


def use_one_thread() -> None:
    """Hold OpenCV and PyTorch to one thread: labelling runs one process a core, so times are for one core."""
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def write_report(path: Path | None, report: dict[str, Any]) -> None:
    """Write the numbers as JSON, with the machine they come from."""
    if path is None:
        return
    import cv2
    import pycolmap

    machine = {
        "system": platform.platform(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "pycolmap": pycolmap.__version__,
        "opencv": cv2.__version__,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_without_nan({"machine": machine, **report}), indent=2, allow_nan=False) + "\n")
    print(f"numbers -> {path}")


def _without_nan(value: Any) -> Any:
    """The same with null for NaN and infinity, which JSON does not know."""
    if isinstance(value, dict):
        return {name: _without_nan(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_without_nan(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
