"""Add planned photographs to rendered maps, and localize target views: policies against each other.

    python -m wheretolook_paper.studies.extend --mesh mesh.glb --work work --out extend.csv

A map of renders along a walk is extended by photographs of each policy, mapped again at known poses, and the same target
views, drawn with another seed than those of the plan, are rendered and localized in it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from numpy.typing import NDArray

from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.extend.places import camera_places, drawn_views, free_places, views_around, yaws_around
from wheretolook.extend.plan import Planner
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, camera_centers, pose_error, poses_looking_along
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.config import PARTNERS, MapConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map_folder import DATABASE_FILE, MapDraft, finish_map, replacing_map
from wheretolook.mapping.rendered_map import RenderedMapReport, plan_walk
from wheretolook.mapping.triangulation import (
    choose_pairs,
    extract_with_colors,
    posed_model,
    shrink_depth,
    surface_overlap,
    triangulate_model,
)
from wheretolook.scenes.loading import load_mesh
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.space.free_space import FreeSpace
from wheretolook_paper.evaluation.comparison import replace_rows


def map_at(scene: Scene, poses: Float, folder: Path, seed: int = 0) -> Path:
    """Map a scene's renders at poses (I, 3, 4) that stay as they are; an existing folder is kept."""
    if folder.is_dir():
        return folder
    assert isinstance(scene.camera, PinholeCamera)
    config = MapConfig(n_images=len(poses))
    with replacing_map(config, folder, seed, 1, "cpu", False) as (partial, run):
        depth: list[NDArray[np.float32]] = []

        def rendered() -> Iterator[NDArray[np.uint8]]:
            for pose in poses:
                rendering = scene.renderer.render(scene.camera, pose[None])
                depth.append(shrink_depth(rendering.depth_m[0]))
                yield rendering.rgb[0]

        stored, colors = zip(*extract_with_colors(rendered(), len(poses), "map", run), strict=True)
        pairs = choose_pairs(surface_overlap(scene.camera, poses, np.stack(depth)), PARTNERS)
        database = partial / DATABASE_FILE
        model = triangulate_model(database, posed_model(scene.camera, poses), stored, colors, pairs, run)
        draft = MapDraft(model, folder, config.max_reprojection_error_px, "Map more images.", database)
        _, fields = finish_map(draft, partial, run)
        RenderedMapReport(
            n_images=len(poses),
            **fields,
            seconds=run.clock.with_total(),
            n_registered=sum(image.num_points3D > 0 for image in model.images.values()),
            n_keypoints=sum(len(pixels) for pixels, _ in stored),
            n_pairs=len(pairs),
            median_distance_to_mesh_cm=np.nan,
            p90_distance_to_mesh_cm=np.nan,
            walk_length_m=np.nan,
            coverage=np.nan,
            visit_radius_m=np.nan,
        ).save(partial)
    return folder


def localized(scene: Scene, folder: Path, poses: Float) -> Float:
    """Return errors (T, 2), in metres and degrees, of rendered views at poses (T, 3, 4) localized in a map."""
    localizer = Localizer(Landmarks.load(folder / "landmarks.npz"), scene.camera, extractor=ExtractorConfig())
    errors = np.full((len(poses), 2), np.inf)
    for row, pose in enumerate(poses):
        result = localizer.localize(scene.renderer.render(scene.camera, pose[None]).rgb[0])
        if result.status == "localized" and result.cam_from_world is not None:
            errors[row] = pose_error(result.cam_from_world, pose)
    return errors


def chosen_by(policy: str, planner: Planner, n: int, least_p: float, seed: int) -> Float:
    """Return poses (n, 3, 4) of candidates by a policy: pairs (planned), singles, random, farthest or worst scored."""
    candidates = planner.candidates
    if policy == "pairs":
        plan = planner.plan(n, least_p)
        return planner.scorer.localization_map.frame.world_from_map.apply_to_poses(plan.views.cam_from_world)
    if policy == "random":
        return candidates[np.random.default_rng(seed).permutation(len(candidates))[:n]]
    centers = camera_centers(candidates)
    taken = camera_centers(planner.images)
    scores = planner.scorer.score(candidates)
    rows: list[int] = []
    for _ in range(n):
        apart = np.linalg.norm(centers[:, None] - taken, axis=2).min(axis=1)
        # the lowest scores are close to one another: those taken are a metre apart
        value = apart if policy == "farthest" else np.where(apart > 1.0, -scores, -np.inf)
        rows.append(int(value.argmax()))
        taken = np.concatenate([taken, centers[rows[-1:]]])
    return candidates[rows]


def main(
    mesh: Path,
    work: Path,
    out: Path,
    images: int = 30,
    n: int = 10,
    views: int = 100,
    policies: tuple[str, ...] = ("none", "pairs", "random", "farthest", "worst", "walk"),
    surface: str = "mesh",
    least_p: float = 0.3,
    seed: int = 0,
    device: str = "cpu",
) -> None:
    """Extend the map of a walk by each policy, localize the target views, and write a row for each policy.

    Args:
        mesh: mesh of the scene.
        work: folder of the maps.
        out: CSV file of the results; rows of the same scene, seed, surface and policy are replaced.
        images: images of the map.
        n: photographs that are added.
        views: target views that are localized.
        policies: none, pairs, random, farthest, worst (scored), walk (of `images` + `n`).
        surface: what the planner knows: mesh, or landmarks.
        least_p: least probability that one of a pair registers.
        seed: of the walk.
        device: where to compute.
    """
    scene = Scene(ColmapFiles(work, mesh=mesh), PinholeCamera(), device=device)
    name = f"{mesh.parent.name if mesh.stem == 'mesh' else mesh.stem}-{seed}"
    scene.mesh = load_mesh(mesh)
    space = FreeSpace(scene.mesh, device=device)
    walks = {size: plan_walk(space, scene.mesh.bounds, size, seed) for size in (images, images + n)}
    poses = {size: poses_looking_along(walk.positions, walk.directions) for size, walk in walks.items()}
    base = map_at(scene, poses[images], work / name / "none", seed)
    look = WhereToLook.from_colmap(base, device=device, mesh=mesh if surface == "mesh" else None)
    height_m = float(np.nanmedian(walks[images].positions[:, 2] - space.floor_below(walks[images].positions)))
    places, _ = camera_places(space, walks[images].positions, height_m, 300)
    # other views than those of the plan
    tests, _ = drawn_views(places, len(places), np.zeros(1), None, (-180, 180), 1000 + seed)
    tests = tests[np.random.default_rng(seed).permutation(len(tests))[:views]]
    audit = look.audit()
    own, _ = free_places(look.localization_map, look.space, (), 300)
    yaws = yaws_around(scene.camera)
    good: dict[str, NDArray[np.bool_]] = {}
    records = []
    for policy in policies:
        start = time.monotonic()
        planner = Planner(look.scorer, look.space, audit.views, views_around(own, yaws, np.zeros(1))[0])
        predicted = audit.share
        added = poses[images][:0]
        if policy not in ("none", "walk"):
            added = chosen_by(policy, planner, n, least_p, seed)
        if policy == "pairs":
            predicted = float(planner.predicted().mean())
        seconds = time.monotonic() - start
        whole = poses[images + n] if policy == "walk" else np.concatenate([poses[images], added])
        folder = work / name / (policy if policy in ("none", "walk", "random", "farthest") else f"{policy}-{surface}")
        errors = localized(scene, map_at(scene, whole, folder, seed), tests)
        good[policy] = np.asarray((errors[:, 0] <= 0.05) & (errors[:, 1] <= 0.4))
        lost, won = (int((good["none"] & ~good[policy]).sum()), int((good[policy] & ~good["none"]).sum()))
        record = {"scene": name, "surface": surface, "policy": policy, "added": len(whole) - images}
        record |= {"good": good[policy].mean(), "coarse": (errors <= (0.25, 2.0)).all(axis=1).mean()}
        record |= {"predicted": predicted, "won": won, "lost": lost, "views": len(tests), "seconds": seconds}
        records.append(record)
        print(record, flush=True)
    replace_rows(out, pd.DataFrame(records).round(4), ["scene", "surface", "policy"])


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
