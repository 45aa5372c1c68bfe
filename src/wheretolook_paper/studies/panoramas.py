"""Localize panoramas against single cut-outs of them, in maps of rendered scenes.

    python -m wheretolook_paper.studies.panoramas --scenes '[building-700, scan.glb]' --out panoramas.csv

A scene is a generated one, `<kind>-<seed>`, or a mesh in metres, and is mapped by rendered images. At sampled places a
panorama is rendered, and localized as a whole (`panorama`, as `wheretolook localize --panorama`) and by each of the six
faces of a cube alone: `best` is the face with the highest probability, `ahead` the first, `any` the one nearest to the true
pose, which nobody knows.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from tqdm.auto import tqdm

from wheretolook.commands.sample import Sample
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import poses as poses_of_table
from wheretolook.geometry.camera import ColmapCamera
from wheretolook.geometry.poses import Float, camera_centers, compose_poses, pose_error, poses_looking_along
from wheretolook.select.image_localizer import ImageLocalizer
from wheretolook.select.localized import Localized
from wheretolook.select.query_images import cut_panorama
from wheretolook_paper.evaluation.comparison import replace_rows
from wheretolook_paper.studies.compare_hloc import map_source


def record(result: Localized, pose: Float, seconds: float = np.nan) -> dict[str, float]:
    """Return errors in metres and degrees, probability and seconds of a localized image with a true pose (3, 4)."""
    errors = (np.inf, np.inf)
    if result.cam_from_world is not None:
        error_m, error_deg = pose_error(result.cam_from_world[0], pose)
        errors = (float(error_m), float(error_deg))
    found = {"error_m": errors[0], "error_deg": errors[1], "probability": result.probability}
    return found | {"n_inliers": result.n_inliers, "seconds": seconds}


def compare(localizer: ImageLocalizer, scene: Scene, pose: Float) -> dict[str, dict[str, float]]:
    """Return the records of a panorama rendered at a pose (3, 4), by method."""
    camera = localizer.images.known_camera("panorama")
    assert isinstance(camera, ColmapCamera)
    rgb = scene.renderer.render(camera, pose[None]).rgb[0]
    start = time.monotonic()
    whole = record(localizer.localize(rgb, camera="panorama"), pose, time.monotonic() - start)
    faces, cam_from_rig = cut_panorama(localizer.images.read(rgb, "panorama", camera))
    alone = [
        record(localizer.localize(face.rgb, camera=face.camera), compose_poses(of_face, pose))
        for face, of_face in zip(faces, cam_from_rig, strict=True)
    ]
    best = max(alone, key=lambda face: face["probability"])
    nearest = min(alone, key=lambda face: max(face["error_m"] / 0.05, face["error_deg"] / 0.4))
    return {"panorama": whole, "best": best, "ahead": alone[0], "any": nearest}


def summarize(table: pd.DataFrame) -> pd.DataFrame:
    """Summarize places by scene and method, and of all scenes: shares right and confident, precision of the confident."""
    rows = []
    right = (table["error_m"] <= 0.05) & (table["error_deg"] <= 0.4)
    table = table.assign(right=right, wrong_place=(table["error_m"] > 0.5) | (table["error_deg"] > 5))
    everywhere = table.assign(scene="all")
    for (scene, method), part in pd.concat([table, everywhere]).groupby(["scene", "method"], sort=False):
        sure = part[part["probability"] >= 0.95]
        row = {"scene": scene, "method": method, "places": len(part), "right": part["right"].mean()}
        row |= {"confident": len(sure), "right_of_confident": int(sure["right"].sum())}
        row |= {"wrong_place_of_confident": int(sure["wrong_place"].sum()), "seconds": part["seconds"].median()}
        rows.append(row)
    return pd.DataFrame(rows)


def main(
    scenes: list[str],
    out: Path,
    places: int = 12,
    images: int = 60,
    work: Path = Path("data/panoramas"),
    device: str = "cpu",
) -> pd.DataFrame:
    """Localize panoramas of all scenes, replace their rows in `out`, and print a summary.

    Args:
        scenes: generated scenes such as building-700, or mesh files.
        out: CSV file, a row for each place and method.
        places: places in each scene.
        images: images that a scene is mapped from.
        work: folder of scenes and maps, which are reused.
        device: where to compute.
    """
    for source in scenes:
        files = map_source(source, images, work, 1, device)
        sample = SampleConfig(keep=0, max_locations=places, max_directions=1)
        (sampled,) = Sample(data=work, name=files.folder.parent.name, device=device, sample=sample).run().scenes
        poses = poses_of_table(sampled.read_table())
        level = poses[:, 2, :3] * (1, 1, 0)
        poses = poses_looking_along(camera_centers(poses), level + 1e-6)
        localizer = ImageLocalizer.open(files.map, device=device)
        scene = Scene(files, device=device)
        rows = []
        for place, pose in enumerate(tqdm(poses, desc=Path(source).stem, unit="place")):
            for method, found in compare(localizer, scene, pose).items():
                rows.append({"scene": Path(source).stem, "place": place, "method": method, **found})
        table = replace_rows(out, pd.DataFrame(rows), ["scene"], "%.5g")
    summary = summarize(table)
    print(summary.to_string(index=False, float_format=lambda value: f"{value:.3f}"))
    return summary


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
