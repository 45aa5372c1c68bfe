"""Measure the CPU time of choosing several looks jointly on one core, given the scores of a viewpoint map.

    python tests/benchmarks/bench_looks.py SCENE_FOLDER [--looks 3] [--directions 500] [--places 30]

The scene folder holds `map/landmarks.npz`, `viewpoints.parquet` and `occlusion.npz`. Scores of all directions are
computed beforehand and not counted, because a viewpoint map stores them. Prints the median and the 10 and 90 %
quantiles over locations.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_files import read_table
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import camera_centers
from wheretolook.looks.selection import best_views
from wheretolook.scorers.weights import load_scorer
from wheretolook.utils.package import WEIGHTS, shipped


def main() -> None:
    """Parse the options, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    for name, default in (("looks", 3), ("directions", 500), ("places", 30)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene = SceneFolder(options.scene, "test")
    localization_map = scene.localization_map()
    scorer = load_scorer(localization_map, str(shipped(WEIGHTS) / "set.safetensors"))
    places = np.unique(np.round(camera_centers(poses(read_table(scene.table))), 9), axis=0)[: options.places]
    directions = direction_lattice(options.directions)
    scores = scorer.score_directions(places, directions)
    best_views(scorer, places[0], directions, scores[0], options.looks)  # warm-up
    seconds = []
    for place, values in zip(places, scores, strict=True):
        start = time.process_time()
        best_views(scorer, place, directions, values, options.looks)
        seconds.append(time.process_time() - start)
    low, middle, high = 1e3 * np.quantile(seconds, (0.1, 0.5, 0.9))
    about = f"{options.looks} looks of {options.directions} directions, {len(localization_map.landmarks):,} landmarks"
    print(f"{about}: {middle:.0f} ms (10 to 90 %: {low:.0f} to {high:.0f}) at {len(places)} places")


if __name__ == "__main__":
    main()
