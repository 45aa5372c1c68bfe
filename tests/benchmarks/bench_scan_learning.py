"""Whether what is learnt from renders of an RGB-D scan holds for photographs of the place.

    python tests/benchmarks/bench_photographs.py --poses 7-scenes/redkitchen/seq-01 --work work/kitchen
    python tests/benchmarks/bench_scan_learning.py --recording 7-scenes/redkitchen/seq-01 --work work/kitchen \\
        --data work/learning --blocks 4 9

For each block of photographs that `wheretolook check` leaves out, the rest is mapped and scanned; views of the scan are
rendered and localized on that map; the scorer that ships is adapted by them (docs/adapt.md), and judged by the block's
photographs, which neither map, scan nor learning has seen. What the place's own photographs teach is told by
bench_photographs.py. `--data` keeps scenes and labels. Intervals (95 %) are by drawing blocks.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.special import expit
from sklearn.metrics import log_loss, roc_auc_score

from wheretolook.cli import main as wheretolook
from wheretolook.config import Experiment
from wheretolook.dataset.layout import Dataset
from wheretolook.evaluation.calibration import expected_calibration_error
from wheretolook.geometry.poses import camera_centers
from wheretolook.holdout.holdout import LeftOut, left_out_blocks, without
from wheretolook.holdout.photo_map import PhotographedMap, open_map
from wheretolook.scorers.adapted.gp_correction import LocalizedViews, adapt
from wheretolook.scorers.adapted.score import log_odds_of
from wheretolook.stages.adapt import labelled_views
from wheretolook.stages.preconditions import open_scene
from wheretolook.utils.reading import read_json_object
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.weights.resolve import load_scorer


def scanned_scene(source: PhotographedMap, left_out: LeftOut, args: argparse.Namespace) -> str:
    """The name of a dataset of the map and the scan without a block, with labelled views of the scan."""
    name = f"without-{left_out.block.number:02}"
    sparse = args.data / name / "sparse"
    if not sparse.is_dir():
        image_ids = np.array(sorted(number for number, image in source.model.images.items() if image.has_pose))
        sparse.mkdir(parents=True)
        without(source.model, image_ids[left_out.block.left_out].tolist()).write_binary(str(sparse))
    common = ["--data", str(args.data)]
    recording = ["--rgbd", str(args.recording), "--scenes.rgbd.model", str(sparse), "--scenes.rgbd.name", "scan"]
    scan = args.data / f"{name}-scan" / "scan"
    mapped = ["--model", str(scan / "frames"), "--mesh", str(scan / "mesh.glb"), "--database", str(source.features)]
    sampled = [
        "--sample.grid",
        args.grid,
        "--sample.max_locations",
        str(args.locations),
        "--sample.max_directions",
        str(args.directions),
    ]
    steps = [
        ["scenes", "--name", f"{name}-scan", *recording],
        ["map", "--name", name, *mapped],
        ["sample", "--name", name, *sampled],
        ["label", "--name", name, "--label.workers", str(args.workers)],
    ]
    for step in steps:
        if wheretolook([*step, *common]) != 0:
            raise SystemExit(f"failed: {' '.join(step)}")
    return name


def judged(source: PhotographedMap, left_out: LeftOut, name: str, args: argparse.Namespace) -> pd.DataFrame:
    """The photographs of a block, and their log-odds before and after learning from the renders."""
    dataset = Dataset.load(args.data / name)
    files = dataset.scenes[0]
    weights = shipped(WEIGHTS) / "set.safetensors"
    scene = open_scene(Experiment(name=name, data=args.data), dataset, files)
    learnt_from = labelled_views(files, scene, files.read_table(), weights)
    learnt = adapt(learnt_from)
    rotation = np.array(read_json_object(args.data / f"{name}-scan" / "scan" / "rgbd.json")["rotation"])
    rows = left_out.views["row"].to_numpy()
    poses = source.poses[rows].copy()
    poses[:, :, :3] = poses[:, :, :3] @ rotation.T
    around = scene.localization_map.of_camera(source.cameras[rows[0]])
    scorer = load_scorer(weights, around)
    before = log_odds_of(scorer.score(poses))
    good = left_out.views["good"].to_numpy(bool)
    group = np.arange(len(rows))
    views = LocalizedViews(before, good, camera_centers(poses), poses[:, 2, :3], group)
    after = learnt.adaptation.log_odds(views)
    print(f"block {left_out.block.number}: {len(learnt_from)} renders, {learnt_from.good.mean():.0%} localize; "
          f"{len(good)} photographs, {good.mean():.0%} localize")  # fmt: skip
    return pd.DataFrame({"block": left_out.block.number, "good": good, "before": before, "after": after})


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog=__doc__.partition("\n\n")[2],
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--recording", type=Path, required=True, help="RGB-D recording of the photographs")
    parser.add_argument("--work", type=Path, required=True, help="what bench_photographs.py --work has kept")
    parser.add_argument("--data", type=Path, required=True, help="folder for scenes and labels")
    parser.add_argument("--blocks", type=int, nargs="*", help="numbers of the blocks to take (default: all)")
    parser.add_argument("--locations", type=int, default=40, help="to render from (default: %(default)s)")
    parser.add_argument("--grid", default="[30, 30, 15]", help="of places over the map (default: %(default)s)")
    parser.add_argument("--directions", type=int, default=25, help="at each (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=1, help="processes that label (default: %(default)s)")
    args = parser.parse_args()
    source = open_map(args.work / "map", args.work / "photographs" / "database.db", True)
    blocks = [
        one
        for one in left_out_blocks(source, args.work / "check" / "work")
        if not args.blocks or one.block.number in args.blocks
    ]
    found = pd.concat([judged(source, one, scanned_scene(source, one, args), args) for one in blocks])
    rng = np.random.default_rng(0)
    parts = [found[found["block"] == one.block.number] for one in blocks]
    drawn = [pd.concat([parts[i] for i in rng.integers(0, len(parts), len(parts))]) for _ in range(1000)]
    for name, measure in MEASURES.items():
        told = []
        for when in ("before", "after"):
            spread = [measure(one["good"], expit(one[when])) for one in drawn if one["good"].nunique() == 2]
            low, high = np.nanquantile(spread, (0.025, 0.975))
            told.append(f"{measure(found['good'], expit(found[when])):.3f} [{low:.3f}, {high:.3f}]")
        print(f"{name:18} {told[0]} -> {told[1]}")


MEASURES = {
    "AUC": roc_auc_score,
    "log loss": log_loss,
    "calibration error": lambda good, chance: expected_calibration_error(chance, good.to_numpy(bool)),
}


if __name__ == "__main__":
    main()
