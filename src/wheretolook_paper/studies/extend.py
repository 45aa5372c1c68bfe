"""Add planned photographs to rendered maps, and localize target views: policies against each other.

    python -m wheretolook_paper.studies.extend --mesh mesh.glb --work work --out extend.csv
    python -m wheretolook_paper.studies.extend --mesh mesh.glb --work work --out extend.csv --policies '[oracle]'

A map of renders along a walk is extended by photographs of each policy, mapped again at known poses, and the same target
views, drawn with another seed than those of the plan, are rendered and localized in it. Rows that the table has are not
computed again; maps, plans and errors are kept in `--work`.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from numpy.typing import NDArray

from wheretolook.dataset.config import LOCALIZED
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.extend.config import TargetOptions
from wheretolook.extend.places import camera_places, drawn_views, photograph_candidates
from wheretolook.extend.plan import Planner
from wheretolook.features.extractor import ExtractorConfig, KeypointExtractor, Keypoints, kind_of
from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float, camera_centers, pose_error, poses_looking_along
from wheretolook.localization.confidence import RIGHT_PLACE_LIMITS
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.config import PARTNERS, MapConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map_folder import DATABASE_FILE, MapDraft, finish_map, replacing_map
from wheretolook.mapping.rendered_map import RenderedMapReport, plan_walk
from wheretolook.mapping.triangulation import (
    choose_pairs,
    image_name,
    posed_model,
    shrink_depth,
    surface_overlap,
    triangulate_model,
)
from wheretolook.scenes.loading import load_mesh
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import MapWarning, WhereToLookError
from wheretolook.utils.processes import WorkerPool, hold
from wheretolook_paper.evaluation.comparison import replace_rows

STRICT, COARSE = (0.05, 0.4), (0.25, 2.0)  # metres, degrees


@dataclass(frozen=True, eq=False)
class Photograph:
    """A rendered view with its keypoints."""

    pose: Float  # (3, 4)
    depth_m: NDArray[np.float32]  # (H, W)
    keypoints: Keypoints
    colors: NDArray[np.uint8]  # (K, 3) at the keypoints


class Photographer:
    """Renders views of a scene and extracts their keypoints, each view once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._extractor = KeypointExtractor(ExtractorConfig())
        self._taken: dict[bytes, Photograph] = {}

    def __call__(self, poses: Float) -> list[Photograph]:
        """Return photographs at poses (I, 3, 4)."""
        return [self._take(np.ascontiguousarray(pose)) for pose in poses]

    def _take(self, pose: Float) -> Photograph:
        if pose.tobytes() not in self._taken:
            rendering = self.scene.renderer.render(self.scene.camera, pose[None])
            keypoints = self._extractor.extract(rendering.rgb[0])
            column, row = keypoints.pixels.astype(np.int64).T
            depth = shrink_depth(rendering.depth_m[0])
            self._taken[pose.tobytes()] = Photograph(pose, depth, keypoints, rendering.rgb[0][row, column])
        return self._taken[pose.tobytes()]


def map_of(photographs: list[Photograph], camera: PinholeCamera, folder: Path, seed: int = 0) -> Path:
    """Map photographs at their poses, which stay as they are; an existing folder is kept."""
    if (folder / "landmarks.npz").is_file():
        return folder
    n_images = len(photographs)
    config = MapConfig(n_images=n_images)
    kind = kind_of(config.extractor.method)
    poses = np.stack([photograph.pose for photograph in photographs])
    with replacing_map(config, folder, seed, 1, "cpu", False) as (partial, run):
        depth = np.stack([photograph.depth_m for photograph in photographs])
        pairs = choose_pairs(surface_overlap(camera, poses, depth), PARTNERS)
        stored = [(one.keypoints.pixels, kind.store(one.keypoints.descriptors)) for one in photographs]
        colors = [photograph.colors for photograph in photographs]
        database = partial / DATABASE_FILE
        model = triangulate_model(database, posed_model(camera, poses), stored, colors, pairs, run)
        draft = MapDraft(model, folder, config.max_reprojection_error_px, "Map more images.", database)
        _, fields = finish_map(draft, partial, run)
        RenderedMapReport(
            n_images=n_images,
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


def errors_in(folder: Path, photographs: list[Photograph], camera: PinholeCamera) -> Float:
    """Return errors (T, 2), in metres and degrees, of photographs localized in a map."""
    localizer = Localizer(Landmarks.load(folder / "landmarks.npz"), camera)
    return np.array([error_of(localizer, one.keypoints, one.pose) for one in photographs]).reshape(-1, 2)


def error_of(localizer: Localizer, keypoints: Keypoints, pose: Float, camera: Camera | None = None) -> Float:
    """Return the error (2,) of an image in metres and degrees; infinite if it does not localize."""
    result = localizer.estimate(keypoints, localizer.match([keypoints])[0], camera)
    if result.status != LOCALIZED or result.cam_from_world is None:
        return np.full(2, np.inf)
    return np.array(pose_error(result.cam_from_world, pose))


def spread(policy: str, planner: Planner, n: int, seed: int) -> Float:
    """Return poses (n, 3, 4) of candidates: random, even (farthest from all others), or worst (scored, a metre apart)."""
    candidates = planner.candidates
    if policy == "random":
        return candidates[np.random.default_rng(seed).permutation(len(candidates))[:n]]
    centers = camera_centers(candidates)
    taken = camera_centers(planner.images)
    scores = planner.scorer.score(candidates)
    rows: list[int] = []
    for _ in range(n):
        apart = np.linalg.norm(centers[:, None] - taken, axis=2).min(axis=1)
        # the lowest scores are close to one another
        value = apart if policy == "even" else np.where(apart > 1.0, -scores, -np.inf)
        rows.append(int(value.argmax()))
        taken = np.concatenate([taken, centers[rows[-1:]]])
    return candidates[rows]


@dataclass(frozen=True, eq=False)
class _Trial:
    """A map to make and the views to localize in it."""

    photographs: list[Photograph]
    views: list[Photograph]
    camera: PinholeCamera
    folder: Path


def _try(trial: _Trial) -> float:
    """Return the share of views that localize in the map of a trial."""
    folder = map_of(trial.photographs, trial.camera, trial.folder)
    return float((errors_in(folder, trial.views, trial.camera) <= STRICT).all(axis=1).mean())


def row_of(plan: dict[str, Any], errors: Float, registered: list[Float]) -> dict[str, Any]:
    """Return columns of the table for errors (T, 2) of target views, and (2,) of each photograph that is added."""
    strict = np.asarray((errors <= STRICT).all(axis=1))
    return {
        "views": len(strict),
        "strict": strict.mean(),
        "coarse": (errors <= COARSE).all(axis=1).mean(),
        "predicted": float(plan["predicted"]),
        "seconds": float(plan["seconds"]),
        "localized": marked(strict),
        "p_registers": " ".join(f"{p:.3f}" for p in plan["p_registers"]),
        "registered": marked((one <= RIGHT_PLACE_LIMITS).all() for one in registered),
    }


def marked(values: Iterable[Any]) -> str:
    """Return a text with an x for each true value and a full stop for each other."""
    return "".join("x" if value else "." for value in values)


def surface_of(policy: str) -> str:
    """Return what a policy knows of the surface: mesh, depth (images of the walk) or landmarks."""
    return policy.partition("-")[2] or "mesh"


class Study:
    """A scene, the map of a walk through it, and target views."""

    def __init__(self, mesh: Path, work: Path, images: int, n: int, views: int, seed: int) -> None:
        self.mesh, self.images, self.n, self.seed = mesh, images, n, seed
        self.scene = Scene(ColmapFiles(work, mesh=mesh), PinholeCamera(), device="cpu")
        self.camera = PinholeCamera()
        self.name = mesh.parent.name if mesh.stem == "mesh" else mesh.stem
        self.work = work / f"{self.name}-{seed}"
        self.scene.mesh = load_mesh(mesh)
        self.take = Photographer(self.scene)
        space = FreeSpace(self.scene.mesh, device="cpu")
        walks = {size: plan_walk(space, self.scene.mesh.bounds, size, seed) for size in (images, images + n)}
        self.walks = {size: poses_looking_along(walk.positions, walk.directions) for size, walk in walks.items()}
        self.walk = self.walks[images]
        positions = walks[images].positions
        height_m = float(np.nanmedian(positions[:, 2] - space.floor_below(positions)))
        self.places = camera_places(space, positions, height_m, 300)[0]
        self.tests = self.drawn(views, 1000)
        self.base = map_of(self.take(self.walk), self.camera, self.work / "none", seed)

    def drawn(self, n: int, stream: int) -> Float:
        """Draw views (n, 3, 4) at all places; those of the plan are drawn with the seed 0."""
        poses, _ = drawn_views(self.places, len(self.places), np.zeros(1), None, (-180, 180), stream + self.seed)
        return poses[np.random.default_rng(self.seed).permutation(len(poses))[:n]]

    def planner(self, surface: str) -> Planner:
        """Return a planner that knows the mesh, the depth images of the walk, or only the landmarks."""
        files: dict[str, Any] = {"mesh": self.mesh} if surface == "mesh" else {}
        if surface == "depth":
            files = {"depth": self.work / "depth"}
            files["depth"].mkdir(exist_ok=True)
            for row, pose in enumerate(self.walk):
                depth = self.scene.renderer.render(self.camera, pose[None]).depth_m[0]
                millimetres = np.where(np.isfinite(depth), depth * 1000, 0).clip(0, 65535).astype(np.uint16)
                cv2.imwrite(str(files["depth"] / image_name(row)), millimetres)
        look = WhereToLook.from_colmap(self.base, device="cpu", **files)
        candidates = photograph_candidates(look.localization_map, look.space, TargetOptions())
        with warnings.catch_warnings(action="ignore", category=MapWarning):  # parts without common landmarks
            return Planner(look.scorer, look.space, look.audit().views, candidates)

    def plan_file(self, policy: str) -> Path:
        """Return the file of a policy's plan."""
        return self.work / "plans" / policy / "plan.npz"

    def chosen(self, policy: str, planner: Planner | None, least_p: float, workers: int, trials: int) -> dict[str, Any]:
        """Return the images of a policy's map, with what was predicted of them; kept in a file."""
        plan: dict[str, Any] = {"poses": self.walk, "predicted": np.nan, "p_registers": np.empty(0), "seconds": 0.0}
        if policy == "walk":
            return plan | {"poses": self.walks[self.images + self.n]}
        file = self.plan_file(policy)
        if file.is_file():
            with np.load(file) as stored:
                return dict(stored)
        start = time.monotonic()
        planner = self.planner(surface_of(policy)) if planner is None else planner
        if policy == "none":
            plan["predicted"] = planner.targets.score.mean()
        elif policy.startswith("pairs"):
            extension = planner.plan(self.n, least_p)
            added = extension.views
            to_world = planner.scorer.localization_map.frame.world_from_map
            plan["poses"] = np.concatenate([self.walk, to_world.apply_to_poses(added.cam_from_world)])
            plan |= {"predicted": extension.predicted.mean(), "p_registers": added.p_registers}
        elif policy == "oracle":
            plan["poses"] = np.concatenate([self.walk, self.oracle(planner, least_p, workers, trials)])
        else:
            plan["poses"] = np.concatenate([self.walk, spread(policy, planner, self.n, self.seed)])
        plan["seconds"] = time.monotonic() - start
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, **plan)
        return plan

    def oracle(self, planner: Planner, least_p: float, workers: int, trials: int) -> Float:
        """Choose pairs greedily by maps that are really made: of those planned best and random ones, step by step."""
        rng = np.random.default_rng(self.seed)
        views = self.take(self.drawn(60, 2000))
        chosen: list[int] = []
        with WorkerPool(workers) as pool:
            while len(chosen) < self.n:
                p = planner.registers()
                usable = planner.pairs[(p[planner.pairs] >= least_p).any(axis=1)]
                usable = usable[~np.isin(usable, chosen).any(axis=1)]
                drawn = [usable[rng.permutation(len(usable))[:100]] for _ in range(trials // 2)]
                pairs = [planner.best(usable)[0], *(planner.best(some)[0] for some in drawn)]
                pairs += list(usable[rng.permutation(len(usable))[: trials - len(pairs)]])
                mapped = [
                    self.take(np.concatenate([self.walk, planner.candidates[[*chosen, *pair]]])) for pair in pairs
                ]
                names = [self.work / "trials" / f"{len(chosen)}-{number}" for number in range(len(pairs))]
                jobs = [_Trial(of, views, self.camera, name) for of, name in zip(mapped, names, strict=True)]
                shares = list(pool.map(_try, jobs))
                best = int(np.argmax(shares))
                print(f"oracle: {len(chosen) + 2} photographs: {shares[best]:.3f}, planned {shares[0]:.3f}", flush=True)
                for row in pairs[best].tolist():
                    planner.add(row)
                    chosen.append(row)
        return planner.candidates[chosen]

    def measure(self, policy: str, plan: dict[str, Any]) -> dict[str, Any]:
        """Map the images of a plan and localize the target views: a row of the table."""
        folder = self.work / policy
        photographs = self.take(plan["poses"])
        errors = errors_in(map_of(photographs, self.camera, folder, self.seed), self.take(self.tests), self.camera)
        registered = []
        for number in range(len(plan["p_registers"])):
            before = len(self.walk) + number
            so_far = map_of(photographs[:before], self.camera, folder / f"first-{number}") if number else self.base
            registered.append(errors_in(so_far, photographs[before : before + 1], self.camera)[0])
        return row_of(plan, errors, registered) | {"added": len(photographs) - self.images}


def main(
    mesh: Path,
    work: Path,
    out: Path,
    images: int = 30,
    n: int = 10,
    views: int = 100,
    policies: tuple[str, ...] = ("none", "random", "even", "worst", "walk", "pairs", "pairs-landmarks", "pairs-depth"),
    least_p: float = 0.3,
    seed: int = 0,
    workers: int = 1,
    trials: int = 32,
    plan_only: bool = False,
) -> None:
    """Extend the map of a walk by each policy, localize the target views, and write a row for each policy.

    Args:
        mesh: mesh of the scene.
        work: folder of the maps.
        out: CSV file of the results.
        images: images of the map.
        n: photographs that are added.
        views: target views that are localized.
        policies: none; random, even (farthest from all others) or worst (scored) ones; walk, a longer one; pairs, planned
            on the mesh, or with -depth or -landmarks on the depth images of the walk or the landmarks alone; oracle,
            greedy by maps that are really made.
        least_p: least probability that one of a pair registers.
        seed: of the walk.
        workers: processes of the oracle.
        trials: maps that the oracle makes for each pair.
        plan_only: keep the plans in `work` and measure nothing.
    """
    start = time.monotonic()
    keys = ["scene", "seed", "policy"]
    study = Study(mesh, work, images, n, views, seed)
    done = pd.read_csv(out, usecols=keys) if out.is_file() else pd.DataFrame(columns=keys)
    planners: dict[str, Planner] = {}
    for policy in policies:
        row = {"scene": study.name, "seed": seed, "policy": policy}
        if (done == row).all(axis=1).any():
            continue
        surface = surface_of(policy)
        try:
            if policy != "walk" and surface not in planners and not study.plan_file(policy).is_file():
                planners[surface] = study.planner(surface)
            plan = study.chosen(policy, planners.get(surface), least_p, workers, trials)
            if len(plan["p_registers"]):
                planners.pop(surface, None)  # it counts the photographs that it chose
            if plan_only:
                continue
            row |= study.measure(policy, plan)
        except WhereToLookError as error:
            print(f"{row}: {error}", flush=True)
            continue
        with hold(out.with_suffix(".lock"), "extend", wait_s=60):
            replace_rows(out, pd.DataFrame([row]).round(4), keys)
        shown = {name: row[name] for name in (*keys, "strict", "coarse", "predicted")}
        print(shown, f"{time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
