"""How well views rendered from an RGB-D scan stand for photographs: both localized against the same map.

    python tests/benchmarks/bench_photographs.py --poses 7-scenes/redkitchen/seq-01 --work work/kitchen
    python tests/benchmarks/bench_rgbd.py --recording 7-scenes/redkitchen/seq-01 --work work/kitchen --blocks 4 6 7

Blocks of neighbouring photographs are left out as `wheretolook check` does, and localized on a map of the others. Here
the frames that are not left out are fused to a mesh, the left-out poses are rendered, and the renders are localized on
the same map. So neither map nor mesh knows the photograph that a render is compared with. The table has for each
appearance (colours at vertices, textures from photographs), with depths as they were read and corrected by the map's
landmarks, the share of views on which render and photograph agree whether they localize well, chance-corrected (Cohen's
kappa), the rank correlation of their inliers, the median of rendered over photographed inliers, and, per method, AUC by
the photographs' labels and by the renders' labels on the same views. `--out` keeps every view.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from scipy.stats import spearmanr
from sklearn.metrics import cohen_kappa_score, roc_auc_score
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.geometry.poses import pose_error
from wheretolook.holdout.checking import check_map
from wheretolook.holdout.holdout import LeftOut, left_out_blocks, without
from wheretolook.holdout.photo_map import MAX_ERROR_DEG, MAX_ERROR_M, PhotographedMap, open_map
from wheretolook.holdout.scores import Scoring
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scans.checks import landmark_readings
from wheretolook.scans.config import RgbdConfig
from wheretolook.scans.depth_correction import DepthCorrection, fit_depth_correction
from wheretolook.scans.frames import RgbdFrame, RgbdFrames
from wheretolook.scans.fusion import fuse
from wheretolook.scans.textures import textured

METHODS = ("set", "expected-inliers", "visible")
APPEARANCES = ("colors", "texture")


class Part:
    """Some frames of a recording."""

    def __init__(self, frames: RgbdFrames, rows: np.ndarray) -> None:
        self.frames = frames
        self.rows = rows

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> RgbdFrame:
        return self.frames[int(self.rows[index])]


def label(localizer: Localizer, rgb: np.ndarray, pose: np.ndarray, prefix: str) -> dict[str, object]:
    """How a render localizes, in columns that begin with the prefix."""
    found = localizer.localize(rgb)
    estimate = np.full((3, 4), np.nan) if found.cam_from_world is None else found.cam_from_world
    error_m, error_deg = (float(error) for error in pose_error(estimate, pose))
    good = found.status == LOCALIZED and error_m < MAX_ERROR_M and error_deg < MAX_ERROR_DEG
    values = {
        "good": good,
        "error_m": error_m,
        "n_inliers": len(found.inlier_rows),
        "empty": float((rgb == 0).all(-1).mean()),
    }
    return {f"{prefix} {name}": value for name, value in values.items()}


def map_without(source: PhotographedMap, left_out: LeftOut) -> tuple[Landmarks, object]:
    """The landmarks, with descriptors, and the model that remain without a block."""
    image_ids = np.array(sorted(number for number, image in source.model.images.items() if image.has_pose))
    rest = without(source.model, image_ids[left_out.block.left_out].tolist())
    return load_colmap_landmarks(source.path, source.features, None, "cpu", rest, progress=False), rest


def rendered_labels(
    frames: RgbdFrames, config: RgbdConfig, source: PhotographedMap, left_out: LeftOut, correct: bool, out: Path | None
) -> pd.DataFrame:
    """The left-out photographs of a block with the labels of renders at their poses."""
    row_of = {name: row for row, name in enumerate(frames.names)}
    at = np.array([row_of[name] for name in left_out.views["image"]])
    hidden = np.array([row_of[source.names[row]] for row in left_out.block.left_out])
    landmarks, rest = map_without(source, left_out)
    kept = np.setdiff1d(np.arange(len(frames)), hidden)
    start = time.perf_counter()
    read_m = frames.survey_m
    if correct:  # by what is left of the map
        frames.correct_depths(fit_depth_correction(*landmark_readings(frames, rest).T) or DepthCorrection())
    part = Part(frames, kept)
    poses = frames.cam_from_world[kept]
    number = left_out.block.number
    colors = fuse(part, frames.camera, poses, config, progress=False)
    meshes = {"colors": colors, "texture": textured(colors, part, frames.camera, poses, progress=False)}
    spent = f"{time.perf_counter() - start:.0f} s"
    print(
        f"block {number}: depths {frames.depth_correction.describe()}; {len(colors.triangles):,} triangles in {spent}"
    )
    localizer = Localizer(landmarks, frames.camera)
    columns = []
    renderers = {name: WarpRenderer(mesh) for name, mesh in meshes.items()}
    for row in at:
        pose = frames.cam_from_world[row]
        found = {}
        for name, renderer in renderers.items():
            found |= label(localizer, renderer.render(frames.camera, pose[None]).rgb[0], pose, name)
        columns.append(found)
    if out is not None:
        row = int(at[len(at) // 2])
        pose = frames.cam_from_world[row][None]
        pictures = [frames[row].rgb, *(one.render(frames.camera, pose).rgb[0] for one in renderers.values())]
        name = f"block-{number:02}{'-corrected' if correct else ''}.png"
        cv2.imwrite(str(out.parent / name), np.hstack(pictures)[:, :, ::-1])
    frames.depth_correction = DepthCorrection()
    frames.survey_m = read_m
    return pd.concat([left_out.views, pd.DataFrame(columns)], axis=1).assign(block=number, corrected=correct)


def summarize(views: pd.DataFrame, appearance: str, depths: str) -> dict[str, object]:
    """One row of the table."""
    good = views["good"].astype(bool)
    rendered = views[f"{appearance} good"].astype(bool)
    row: dict[str, object] = {"appearance": appearance, "depths": depths, "views": len(views), "good": int(good.sum())}
    row |= {"good_rendered": int(rendered.sum()), "agree": float((good == rendered).mean())}
    row["kappa"] = float(cohen_kappa_score(good, rendered))
    row["inliers_rank_correlation"] = float(spearmanr(views["n_inliers"], views[f"{appearance} n_inliers"])[0])
    both = views[good & rendered]
    row["inliers_ratio"] = float((both[f"{appearance} n_inliers"] / both["n_inliers"]).median())
    row["error_m"] = float(both[f"{appearance} error_m"].median())
    row["error_m_photographs"] = float(both["error_m"].median())
    for method in METHODS:
        for name, truth in (("photographs", good), ("renders", rendered)):
            known = truth.nunique() == 2
            row[f"auc_{method}_{name}"] = float(roc_auc_score(truth, views[method])) if known else float("nan")
    return row


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog=__doc__.partition("\n\n")[2],
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--recording", type=Path, required=True, help="RGB-D recording of the photographs")
    parser.add_argument("--work", type=Path, required=True, help="what bench_photographs.py --work has kept")
    parser.add_argument("--blocks", type=int, nargs="*", help="numbers of the blocks to take (default: all)")
    parser.add_argument("--voxel-m", type=float, default=0.01, help="of the fusion (default: %(default)s)")
    parser.add_argument("--depth-camera", type=float, nargs=4, help="fx, fy, cx, cy of the depth images")
    parser.add_argument("--color-from-depth-m", type=float, nargs=3, help="the depth camera in the colour camera")
    parser.add_argument("--depth-scale", type=float, default=0, help="units of depth in the map's metre")
    parser.add_argument("--out", type=Path, help="CSV file of every view, with a picture of each block beside it")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    given = {
        "depth_camera": tuple(args.depth_camera or ()),
        "color_from_depth_m": tuple(args.color_from_depth_m or ()),
        "depth_scale": args.depth_scale,
    }
    source = open_map(args.work / "map", args.work / "photographs" / "database.db", True)
    with tempfile.TemporaryDirectory() as upright:  # as the check has turned it
        source.model.write_binary(upright)
        config = RgbdConfig(args.recording, model=Path(upright), voxel_m=args.voxel_m, appearance="colors", **given)
        frames = RgbdFrames(config)
    kept = args.work / "check" / "work"
    blocks = [one for one in left_out_blocks(source, kept) if not args.blocks or one.block.number in args.blocks]
    steps = [(one, correct) for one in blocks for correct in (False, True)]
    made = [
        rendered_labels(frames, config, source, one, correct, args.out)
        for one, correct in tqdm(steps, "leave out", unit="scan")
    ]
    scores = check_map(source, kept, Scoring(also=METHODS[1:])).views.rename(columns={"score": METHODS[0]})
    views = pd.concat(made).merge(scores[["row", "block", *METHODS]], on=["row", "block"], how="left")
    if args.out:
        views.to_csv(args.out, index=False)
    rows = []
    for correct, depths in ((False, "as read"), (True, "corrected")):
        rows += [summarize(views[views["corrected"] == correct], name, depths) for name in APPEARANCES]
    print(pd.DataFrame(rows).T.to_string(header=False, float_format="{:.3f}".format))


if __name__ == "__main__":
    main()
