"""Poses of the images that a map was made from, in a file small enough to travel without the COLMAP model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import MODEL_FILES, read_model
from wheretolook.utils.errors import MapError
from wheretolook.utils.npz_files import load_npz, save_npz

if TYPE_CHECKING:
    import pycolmap

CAMERAS_FILE = "cameras.npz"  # lies beside the landmarks


def colmap_poses(model_dir: str | Path, reconstruction: pycolmap.Reconstruction | None = None) -> Float:
    """Poses cam_from_world (M, 3, 4) float64 of the images of a COLMAP model that have one, in the order of their ids.

    The model is read from its folder unless the reconstruction is given.

    Raises:
        MapError: the folder or a file is missing or corrupt, or no image has a pose.
    """
    images = (reconstruction or read_model(model_dir)).images
    posed = [images[number] for number in sorted(images) if images[number].has_pose]
    if not posed:
        raise MapError("the map has no images", path=model_dir, value=0, fix="Run the map stage again.")
    return np.stack([image.cam_from_world().matrix() for image in posed])


def holds_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model, binary or text."""
    return any(all((folder / (name + suffix)).is_file() for name in MODEL_FILES) for suffix in (".bin", ".txt"))


def save_mapping_poses(cam_from_world: Float, path: str | Path) -> None:
    """Write poses (M, 3, 4) in single precision as an NPZ file, atomically. The same poses give the same bytes."""
    save_npz(Path(path), {"cam_from_world": np.asarray(cam_from_world, dtype=np.float32)})


def load_mapping_poses(path: str | Path) -> Float:
    """Read what `save_mapping_poses` wrote, (M, 3, 4) float32.

    Raises:
        MapError: the file is missing, damaged, or does not hold poses.
    """
    path, fix = Path(path), "Run the map stage again, or remove it to read the COLMAP model beside it instead."
    if not path.is_file():
        raise MapError("there is no file of the mapping images' poses", path=path, fix="Run the map stage again.")
    try:
        poses = load_npz(path)["cam_from_world"]
    except (ValueError, KeyError) as error:
        raise MapError(f"cannot read the mapping images' poses: {error}", path=path, fix=fix) from error
    if poses.ndim != 3 or poses.shape[1:] != (3, 4) or not len(poses) or not np.isfinite(poses).all():
        raise MapError("these are no poses of mapping images", path=path, value=poses.shape, fix=fix)
    return np.asarray(poses, dtype=np.float32)
