"""Measure the CPU time of choosing several looks jointly on one core, given the scores of a viewpoint map.

    python tests/benchmarks/bench_looks.py --scene SCENE_FOLDER [--looks 3] [--directions 500] [--places 30]

The scene folder holds `map/landmarks.npz`, `viewpoints.parquet` and `occlusion.npz`. Scores of all directions are
computed beforehand and not counted, because a viewpoint map stores them.
"""

import itertools
import time

import numpy as np
from common import options, timed, use_one_thread

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_files import read_table
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import camera_centers
from wheretolook.looks.selection import best_views
from wheretolook.scorers.weights import load_scorer


def main():
    args = options(__doc__, scene=..., looks=3, directions=500, places=30)
    use_one_thread()
    scene = SceneFolder(args.scene, "test")
    localization_map = scene.localization_map()
    scorer = load_scorer(localization_map)
    places = np.unique(np.round(camera_centers(poses(read_table(scene.table))), 9), axis=0)[: args.places]
    directions = direction_lattice(args.directions)
    given = itertools.cycle([*zip(places, scorer.score_directions(places, directions), strict=True)])

    def choose():
        place, scores = next(given)
        best_views(scorer, place, directions, scores, args.looks)

    about = f"{args.looks} looks of {args.directions} directions, {len(localization_map.landmarks):,} landmarks"
    timed(about, choose, len(places), clock=time.process_time)


if __name__ == "__main__":
    main()
