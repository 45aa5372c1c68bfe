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


def check_mask(scorer: Scorer, camera_z: float | None) -> None:
    """Raise ConfigError if the height of the camera or the unit of the map is unknown, or scores are no probabilities."""
    scorer.localization_map.frame.check_metric("a mask for Nav2 is")
    reject(
        (camera_z is None, "a mask for Nav2 needs the height of the camera: give --camera-z, its z in metres", None),
        (not is_probability(scorer.name), "a mask for Nav2 is of probabilities, as of the method set", scorer.name),
    )


def write_mask(folder: Path, points: Float, probability: Float, cell_m: float) -> None:
    """Write mask.pgm, with mask.yaml for costs and speeds, and keepout.yaml for places where no view localizes.

    Points (N, 3) in the world are on a lattice of squares `cell_m` wide, at one height; `probability` (N,) is that of the
    best view there, NaN for none. In mask.yaml (mode scale) a cell is 100 times one less the probability, at most 99,
    since 100 is lethal, and 0, which no filter acts on, where no view is. In keepout.yaml (mode trinary) it is 100 where the
    probability is below 0.5, else 0. Raises SceneError if there are no views, ConfigError if the folder holds something else.
    """
    check_output_folder(folder, (folder / "mask.yaml").is_file())
    known = np.isfinite(probability)
    if not known.any():
        raise SceneError("no view is at this height of the camera", value=points[0, 2], fix="Correct --camera-z.")
    at = points[known, :2]
    x, y = corner = at.min(axis=0) - cell_m / 2
    column, row = np.floor((at - corner) / cell_m).astype(np.int64).T
    pixels = np.full((row.max() + 1, column.max() + 1), 255, dtype=np.uint8)
    pixels[row, column] = np.clip(np.rint(255 * probability[known]), 2, 254)  # 1 is lethal, 255 no view
    height, width = pixels.shape
    write_bytes(folder / "mask.pgm", b"P5\n%d %d\n255\n" % (width, height) + pixels[::-1].tobytes())
    about = f"image: mask.pgm\nresolution: {cell_m}\norigin: [{x}, {y}, 0.0]\nnegate: 0\n"
    write_text(folder / "mask.yaml", f"{about}mode: scale\noccupied_thresh: 1.0\nfree_thresh: 0.0\n")
    write_text(folder / "keepout.yaml", f"{about}mode: trinary\noccupied_thresh: 0.5\nfree_thresh: 0.499\n")


def places_at_height(viewpoint_map: ViewpointMap, z_m: float) -> tuple[Float, Float, float]:
    """Return centres (N, 3) of squares in the world at a height, the best scores there (N,), NaN for none, and their width."""
    grid = viewpoint_map.grid
    cell_m = float(grid.voxel_m[:2].min())
    x, y = (np.arange(grid.lower[axis] + cell_m / 2, grid.upper[axis], cell_m) for axis in (0, 1))
    points = np.stack(np.meshgrid(x, y, z_m), axis=-1).reshape(-1, 3)
    return points, viewpoint_map.best_many(viewpoint_map.world_from_map.inverse.apply(points)).score, cell_m
