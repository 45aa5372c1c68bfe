"""How long it takes to choose looks together: CPU time on one core, from the scores of a viewpoint map.

    python tests/benchmarks/bench_looks.py SCENE_FOLDER [--looks 3] [--directions 500] [--places 30]

The folder is a scene's, with `map/landmarks.npz`, `viewpoints.parquet`, `occlusion.npz`. Scores of all directions at a
place are computed before and not counted: a viewpoint map holds them. Told are median and spread over places, in CPU
time of this process, which a busy machine disturbs less than the clock. Nothing here fails on time.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import poses, read_table
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import camera_centers
from wheretolook.looks.around import best_looks
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.weights.resolve import load_scorer


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    for name, default in (("looks", 3), ("directions", 500), ("places", 30)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene = SceneFolder(options.scene, "test")
    around = scene.localization_map()
    scorer = load_scorer(str(shipped(WEIGHTS) / "set.safetensors"), around)
    places = np.unique(np.round(camera_centers(poses(read_table(scene.table))), 9), axis=0)[: options.places]
    directions = direction_lattice(options.directions)
    scores = scorer.score_around(places, directions)
    best_looks(scorer, places[0], directions, scores[0], options.looks)  # what is made once
    seconds = []
    for place, values in zip(places, scores, strict=True):
        start = time.process_time()
        best_looks(scorer, place, directions, values, options.looks)
        seconds.append(time.process_time() - start)
    low, middle, high = 1e3 * np.quantile(seconds, (0.1, 0.5, 0.9))
    about = f"{options.looks} looks of {options.directions} directions, {len(around.landmarks):,} landmarks"
    print(f"{about}: {middle:.0f} ms (10 to 90 %: {low:.0f} to {high:.0f}) at {len(places)} places")


if __name__ == "__main__":
    main()
