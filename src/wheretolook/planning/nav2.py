"""Masks for the costmap filters of Nav2, in the format of its map_server: where a camera localizes, seen from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import is_probability
from wheretolook.utils.errors import SceneError, reject
from wheretolook.utils.files import check_output_folder, write_bytes, write_text


def check_mask(folder: Path, scorer: Scorer, camera_z: float | None) -> None:
    """Raise ConfigError if the folder holds something else, the height or the unit is unknown, or scores are no probabilities."""
    check_output_folder(folder, (folder / "mask.yaml").is_file())
    scorer.localization_map.frame.check_metric("a mask for Nav2 is")
    reject(
        (camera_z is None, "a mask for Nav2 needs the height of the camera: give --camera-z, its z in metres", None),
        (not is_probability(scorer.name), "a mask for Nav2 is of probabilities, as of the method set", scorer.name),
    )


def write_mask(folder: Path, points: Float, probability: Float, cell_m: float) -> None:
    """Write costs.yaml (KeepoutFilter), keepout.yaml (the same, to close places off) and mask.yaml (SpeedFilter), with images.

    Points (N, 3) in the world are on a lattice of squares `cell_m` wide, at one height; `probability` (N,) is that of the
    best view there, NaN for none. In costs.yaml (mode raw) a cell is 100 times one less the probability, at most 99,
    since 100 is lethal, and -1 where no view is: 0 would make unknown cells of a costmap free. In mask.yaml (mode scale)
    these are 0, no limit, since the SpeedFilter rejects -1. In keepout.yaml (mode trinary) a cell is 100 where the
    probability is below 0.5, else -1. Raises SceneError if there are no views.
    """
    known = np.isfinite(probability)
    if not known.any():
        raise SceneError(
            "no view is at this height of the camera", value=float(points[0, 2]), fix="Correct --camera-z."
        )
    at = points[known, :2]
    x, y = corner = at.min(axis=0) - cell_m / 2
    column, row = np.floor((at - corner) / cell_m).astype(np.int64).T
    pixels = np.full((row.max() + 1, column.max() + 1), 255, dtype=np.uint8)
    pixels[row, column] = np.clip(np.rint(255 * probability[known]), 2, 254)  # 1 is lethal, 255 no view
    height, width = pixels.shape
    costs = np.where(pixels == 255, 255, np.rint(100 - pixels / 2.55)).astype(np.uint8)  # above 100 is -1
    for image, values in (("mask.pgm", pixels), ("costs.pgm", costs)):
        write_bytes(folder / image, b"P5\n%d %d\n255\n" % (width, height) + values[::-1].tobytes())
    about = f"resolution: {cell_m}\norigin: [{x}, {y}, 0.0]\nnegate: 0\nfree_thresh: 0.0\n"
    for name, image, mode, occupied in (
        ("costs", "costs", "raw", 1.0),
        ("mask", "mask", "scale", 1.0),
        ("keepout", "mask", "trinary", 0.5),
    ):
        text = f"image: {image}.pgm\n{about}mode: {mode}\noccupied_thresh: {occupied}\n"
        write_text(folder / f"{name}.yaml", text)


def places_at_height(viewpoint_map: ViewpointMap, z_m: float) -> tuple[Float, Float, float]:
    """Return centres (N, 3) of squares in the world at a height, the best scores there (N,), NaN for none, and their width."""
    grid = viewpoint_map.grid
    cell_m = float(grid.voxel_m[:2].min())
    x, y = (np.arange(grid.lower[axis] + cell_m / 2, grid.upper[axis], cell_m) for axis in (0, 1))
    points = np.stack(np.meshgrid(x, y, z_m), axis=-1).reshape(-1, 3)
    return points, viewpoint_map.best_many(viewpoint_map.world_from_map.inverse.apply(points)).score, cell_m
