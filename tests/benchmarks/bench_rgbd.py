"""How well views rendered from an RGB-D scan stand for photographs: both localized against the same map.

    python tests/benchmarks/bench_photographs.py --poses 7-scenes/redkitchen/seq-01 --work work/kitchen
    python tests/benchmarks/bench_rgbd.py --recording 7-scenes/redkitchen/seq-01 --work work/kitchen

`bench_photographs.py` maps the photographs, leaves out blocks of neighbouring ones and localizes these on a map of the
others. Here the frames that are not left out are fused to a mesh, the left-out poses are rendered, and the renders are
localized on the same map. So neither map nor mesh knows the photograph that a render is compared with. The table has
for each appearance (colours at vertices, textures from photographs) the share of views on which render and photograph
agree whether they localize well, chance-corrected (Cohen's kappa), the rank correlation of their inliers, the median of
rendered over photographed inliers, and, per method, AUC by the photographs' labels and by the renders' labels on the
same views. `--out` keeps every view.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from bench_photographs import MAP, MAX_ERROR_DEG, MAX_ERROR_M
from scipy.stats import spearmanr
from sklearn.metrics import cohen_kappa_score, roc_auc_score
from tqdm.auto import tqdm

from wheretolook.geometry.poses import pose_error
from wheretolook.labelling.localizer import Localizer
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scans.config import RgbdConfig
from wheretolook.scans.frames import RgbdFrame, RgbdFrames
from wheretolook.scans.fusion import fuse
from wheretolook.scans.textures import textured
from wheretolook.viewpoints.table import LOCALIZED

METHODS = ("set", "expected-inliers", "visible")


class Part:
    """Some frames of a recording."""

    def __init__(self, frames: RgbdFrames, rows: np.ndarray) -> None:
        self.frames, self.rows = frames, rows

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


def rendered_labels(frames: RgbdFrames, config: RgbdConfig, block: Path, shown: Path | None) -> pd.DataFrame:
    """The left-out photographs of a block with the labels of renders at their poses."""
    labels = pd.read_csv(block / "labels.csv")
    row_of = {name: row for row, name in enumerate(frames.names)}
    left_out = np.array([row_of[name] for name in labels["image"]])
    rest = np.setdiff1d(np.arange(len(frames)), left_out)
    part, poses = Part(frames, rest), frames.cam_from_world[rest]
    start = time.perf_counter()
    colors = fuse(part, frames.camera, poses, config, progress=False)
    fused = time.perf_counter()
    meshes = {"colors": colors, "texture": textured(colors, part, frames.camera, poses, progress=False)}
    spent = f"fused in {fused - start:.0f} s, textured in {time.perf_counter() - fused:.0f} s"
    print(f"{block.name}: {len(colors.triangles):,} triangles, {spent}")
    localizer = Localizer(Landmarks.load(block / "landmarks.npz"), frames.camera, extractor=MAP.extractor)
    columns = []
    renderers = {name: WarpRenderer(mesh) for name, mesh in meshes.items()}
    for row in left_out:
        pose, found = frames.cam_from_world[row], {}
        images = {name: renderer.render(frames.camera, pose[None]).rgb[0] for name, renderer in renderers.items()}
        for name, rgb in images.items():
            found |= label(localizer, rgb, pose, name)
        columns.append(found)
    if shown is not None:
        row = int(left_out[len(left_out) // 2])
        pose = frames.cam_from_world[row][None]
        pictures = [frames[row].rgb, *(one.render(frames.camera, pose).rgb[0] for one in renderers.values())]
        cv2.imwrite(str(shown / f"{block.name}.png"), np.hstack(pictures)[:, :, ::-1])
    return pd.concat([labels, pd.DataFrame(columns)], axis=1).assign(block=block.name)


def summarize(views: pd.DataFrame, appearance: str) -> dict[str, object]:
    """One row of the table."""
    good, rendered = views["good"].astype(bool), views[f"{appearance} good"].astype(bool)
    row: dict[str, object] = {"appearance": appearance, "views": len(views), "good": int(good.sum())}
    row |= {"good_rendered": int(rendered.sum()), "agree": float((good == rendered).mean())}
    row["kappa"] = float(cohen_kappa_score(good, rendered))
    row["inliers_rank_correlation"] = float(spearmanr(views["n_inliers"], views[f"{appearance} n_inliers"])[0])
    both = views[good & rendered]
    row["inliers_ratio"] = float((both[f"{appearance} n_inliers"] / both["n_inliers"]).median())
    row["error_m"], row["error_m_photographs"] = (
        float(both[f"{appearance} error_m"].median()),
        float(both["error_m"].median()),
    )
    for method in METHODS:
        if method in views:
            scores = views[method] * (views["n_landmarks"] if method != "set" else 1)
            for name, truth in (("photographs", good), ("renders", rendered)):
                row[f"auc_{method}_{name}"] = (
                    float(roc_auc_score(truth, scores)) if truth.nunique() == 2 else float("nan")
                )
    return row


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog=__doc__.partition("\n\n")[2],
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--recording", type=Path, required=True, help="RGB-D recording of the photographs")
    parser.add_argument("--work", type=Path, required=True, help="what bench_photographs.py --work has kept")
    parser.add_argument("--blocks", nargs="*", help="names of the blocks to take (default: all)")
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
    config = RgbdConfig(args.recording, model=args.work / "map", voxel_m=args.voxel_m, appearance="colors", **given)
    frames = RgbdFrames(config)
    blocks = [path for path in sorted((args.work / "blocks").iterdir()) if not args.blocks or path.name in args.blocks]
    shown = args.out.parent if args.out else None
    views = pd.concat([rendered_labels(frames, config, block, shown) for block in tqdm(blocks, "leave out")])
    scores = pd.read_csv(args.work / "views.csv")
    scores["block"] = [block_name(args.work, scores, number) for number in scores["block"]]
    columns = ["row", "block", *(name for name in METHODS if name in scores)]
    views = views.merge(scores[columns], on=["row", "block"], how="left")
    if args.out:
        views.to_csv(args.out, index=False)
    table = pd.DataFrame([summarize(views, name) for name in ("colors", "texture")])
    print(table.T.to_string(header=False, float_format="{:.3f}".format))


def block_name(work: Path, scores: pd.DataFrame, number: int) -> str:
    """The folder of a block's number in `views.csv`: its first row and one past its last."""
    rows = scores.loc[scores["block"] == number, "row"]
    return f"{rows.min()}-{rows.max() + 1}"


if __name__ == "__main__":
    main()
