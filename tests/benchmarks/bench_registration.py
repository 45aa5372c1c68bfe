"""Labels by COLMAP's mapper, as the paper makes them, against labels by our localizer: agreement, errors and time.

    python tests/benchmarks/bench_registration.py
    python tests/benchmarks/bench_registration.py --scene FOLDER --extractor colmap --out registration.json

The paper registers each rendered image into the COLMAP model with COLMAP's mapper (Sec. 3.3). That is done here with
pycolmap: the image goes into a copy of the map's database, is matched against every image of the map with geometric
verification, and is registered by the incremental mapper, all with COLMAP's default options. An image that is not
registered is a negative; the pose of one that is gets its label from the error (5 cm, 0.4 degrees), as ours does.

Both sides get the same images, and keypoints of the same extractor, which is also the map's: --extractor colmap is
COLMAP's own extraction. So what is compared is localization: extraction runs once and counts on both sides. Rendering
is needed by both and is not in their times.
Every side runs on one thread where it can be told to; CPU seconds count all threads, so they are the fair measure where
COLMAP's matching and verification overlap. What COLMAP needs once is not in its time a viewpoint but reported beside
it: the copy of the database, the mapper's cache and the model. Several viewpoints are matched in one call, because
COLMAP then reads the map's descriptors once for all of them. After each viewpoint its registration is undone; the model
is neither refined nor extended by it.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import bench_scenes
import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import LOCALIZED, poses
from wheretolook.features.config import ExtractorConfig
from wheretolook.features.descriptors import quantize_descriptors
from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.keypoints import Keypoints
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, camera_centers, pose_error
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.rendered_map import build_map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.utils.colmap import quiet_colmap

LIMIT_M = 0.05
LIMIT_DEG = 0.4
FEW_INLIERS = 10
"""What our localizer asks for by default, and COLMAP 30: tells how much of the disagreement is due to that."""
BINS_M = (0.0, 0.5, 1.0, 1.5, 2.0, np.inf)
STAGES = ("extract", "store", "match_and_verify", "register")


class Stopwatch:
    """Wall-clock and CPU seconds of named stages, one entry a call."""

    def __init__(self) -> None:
        self.wall: dict[str, list[float]] = {}
        self.cpu: dict[str, list[float]] = {}

    @contextmanager
    def __call__(self, stage: str, share: int = 1) -> Iterator[None]:
        """Time a block; its time is spread evenly over `share` entries."""
        wall = time.perf_counter()
        cpu = time.process_time()
        yield
        self.wall.setdefault(stage, []).extend([(time.perf_counter() - wall) / share] * share)
        self.cpu.setdefault(stage, []).extend([(time.process_time() - cpu) / share] * share)

    def totals(self, stages: Sequence[str]) -> tuple[Float, Float]:
        """Wall-clock and CPU seconds of each viewpoint over some stages."""
        return (sum(np.array(self.wall[name]) for name in stages), sum(np.array(self.cpu[name]) for name in stages))


class ColmapRegistration:
    """Registers images into a map with COLMAP's matcher and incremental mapper, each as if it were the only one.

    Args:
        map_dir: a map built with its database kept.
        folder: for the copy of the database.
        clock: times what is needed once: "copy", "cache" and "model".
        seed: of COLMAP's sampling; everything else is COLMAP's default.
    """

    def __init__(self, map_dir: Path, folder: Path, clock: Stopwatch, seed: int) -> None:
        self._map_dir = map_dir
        self._clock = clock
        self._database = folder / "queries.db"
        self._list = folder / "pairs.txt"
        with clock("copy"):
            shutil.copy(map_dir / "database.db", self._database)
        self._connection = pycolmap.Database.open(str(self._database))
        mapped = self._connection.read_all_images()
        self._mapped_names = [image.name for image in mapped]
        self._next_id = 1 + max(i.image_id for i in mapped)
        self._matching = pycolmap.FeatureMatchingOptions(num_threads=1)
        self._verification = pycolmap.TwoViewGeometryOptions()
        self._verification.ransac.random_seed = seed
        self._options = pycolmap.IncrementalMapperOptions(random_seed=seed, num_threads=1)

    def add(self, keypoints: Keypoints) -> int:
        """Store an image of the map's camera in the database. Returns its id."""
        image_id, self._next_id = self._next_id, self._next_id + 1
        database = self._connection
        database.write_image(pycolmap.Image(name=_name(image_id), camera_id=1, image_id=image_id), use_image_id=True)
        frame = pycolmap.Frame(frame_id=image_id, rig_id=1)
        frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1), image_id))
        database.write_frame(frame, use_frame_id=True)
        database.write_keypoints(image_id, keypoints.pixels)
        values = quantize_descriptors(keypoints.descriptors)
        database.write_descriptors(image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, values))
        return image_id

    def match(self, image_ids: Sequence[int]) -> None:
        """Match images against all of the map's, and verify the matches geometrically."""
        self._list.write_text("".join(f"{_name(i)} {mapped}\n" for i in image_ids for mapped in self._mapped_names))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=str(self._list))
        with quiet_colmap():
            pycolmap.match_image_pairs(
                str(self._database), self._matching, pairing, self._verification, device=pycolmap.Device.cpu
            )

    def open_model(self) -> None:
        """Read the matches of all images and the model, once."""
        with self._clock("cache"):
            options = pycolmap.DatabaseCacheOptions(min_num_matches=15, load_all_images=True)
            with quiet_colmap():
                cache = pycolmap.DatabaseCache.create(self._connection, options)
        with self._clock("model"):
            self._model = pycolmap.Reconstruction(str(self._map_dir))
            self._mapper = pycolmap.IncrementalMapper(cache)
            self._mapper.begin_reconstruction(self._model)

    def register(self, image_id: int) -> bool:
        """Estimate an image's pose by COLMAP's default options. Returns whether there is one."""
        return bool(self._mapper.register_next_image(self._options, image_id))

    def result(self, image_id: int) -> tuple[Float, int]:
        """Pose (3, 4) cam_from_world of a registered image, and its inliers."""
        image = self._model.images[image_id]
        return np.asarray(image.cam_from_world().matrix()), image.num_points3D

    def undo(self, image_id: int) -> None:
        """Take a registered image out of the model again."""
        self._mapper.observation_manager.deregister_frame(self._model.images[image_id].frame_id)

    @contextmanager
    def asking_for(self, min_inliers: int) -> Iterator[None]:
        """With another least number of inliers than COLMAP's default."""
        default = self._options.abs_pose_min_num_inliers
        self._options.abs_pose_min_num_inliers = min_inliers
        yield
        self._options.abs_pose_min_num_inliers = default

    def state(self) -> tuple[Any, ...]:
        """All of the model that a registration might change."""
        points = sorted(self._model.points3D.items())
        return (
            b"".join(point.xyz.tobytes() for _, point in points),
            [(i, point.track.length()) for i, point in points],
            [camera.params.tolist() for camera in self._model.cameras.values()],
            [
                (i, self._model.images[i].cam_from_world().matrix().tobytes())
                for i in sorted(self._model.reg_image_ids())
            ],
        )


def _name(image_id: int) -> str:
    return f"query-{image_id:06d}.png"


def label_by_colmap(
    colmap: ColmapRegistration, keypoints: Sequence[Keypoints], true_poses: Float, clock: Stopwatch, chunk: int
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Results with COLMAP's default options, and with `FEW_INLIERS` asked for (not timed)."""
    ids = []
    for one in tqdm(keypoints, "COLMAP: store", unit="view"):
        with clock("store"):
            ids.append(colmap.add(one))
    with tqdm(total=len(ids), desc="COLMAP: match", unit="view") as bar:
        for start in range(0, len(ids), chunk):
            some = ids[start : start + chunk]
            with clock("match_and_verify", len(some)):
                colmap.match(some)
            bar.update(len(some))
    colmap.open_model()
    before = colmap.state()
    default = []
    lenient = []

    def outcome(registered: bool, image_id: int) -> tuple[Float | None, int]:
        if not registered:
            return None, 0
        found = colmap.result(image_id)
        colmap.undo(image_id)
        return found

    for image_id in tqdm(ids, "COLMAP: register", unit="view"):
        with clock("register"):
            registered = colmap.register(image_id)
        default.append(outcome(registered, image_id))
        with colmap.asking_for(FEW_INLIERS):
            lenient.append(outcome(colmap.register(image_id), image_id))
    if colmap.state() != before:
        raise RuntimeError("registering and undoing it has changed the model: later viewpoints are not comparable")
    return results(default, true_poses), results(lenient, true_poses)


class TimedExtractor(KeypointExtractor):
    """Takes the time of an extraction and keeps what it found, so that the other side gets the same keypoints."""

    def __init__(self, config: ExtractorConfig, clock: Stopwatch) -> None:
        super().__init__(config)
        self.found: list[Keypoints] = []
        self._clock = clock

    def extract(self, rgb: NDArray[np.uint8]) -> Keypoints:
        with self._clock("extract"):
            keypoints = super().extract(rgb)
        self.found.append(keypoints)
        return keypoints


def label_by_localizer(
    localizer: Localizer, images: Iterable[NDArray[np.uint8]], true_poses: Float, clock: Stopwatch
) -> tuple[pd.DataFrame, list[Keypoints]]:
    """Results of our localizer, and the keypoints it found."""
    extractor = TimedExtractor(localizer.extractor.config, clock)
    found = []
    for index, rgb in enumerate(images):
        if index == 0:  # with the localizer's own extractor: what is set up on the first call is not measured
            localizer.localize(rgb)
            localizer.extractor = extractor
        with clock("localize"):
            one = localizer.localize(rgb)
        pose = one.cam_from_world if one.status == LOCALIZED else None
        found.append((pose, len(one.inlier_rows) if pose is not None else 0))
    return results(found, true_poses), extractor.found


def results(found: Sequence[tuple[Float | None, int]], true_poses: Float) -> pd.DataFrame:
    """Whether there is a pose, its inliers, its errors and its label, one row a viewpoint."""
    estimates = np.stack([np.full((3, 4), np.nan) if pose is None else pose for pose, _ in found])
    error_m, error_deg = pose_error(estimates, true_poses)
    return pd.DataFrame(
        {
            "localized": [pose is not None for pose, _ in found],
            "n_inliers": [n for _, n in found],
            "error_m": error_m,
            "error_deg": error_deg,
            "good": (error_m < LIMIT_M) & (error_deg < LIMIT_DEG),
        }
    )


def compare(name: str, colmap: pd.DataFrame, ours: pd.DataFrame) -> dict[str, Any]:
    """Print and return how far two sets of labels agree."""
    same = bench_scenes.agreement(colmap["good"].to_numpy(), ours["good"].to_numpy())
    both = colmap["good"] & ours["good"]
    print(
        f"\n{name}: labels equal {same['equal']:.1%}, kappa {same['kappa']:.3f}; both good {same['both']}, "
        f"only COLMAP's {same['only_first']}, only ours {same['only_second']}, neither {same['neither']}"
    )
    sides = {}
    print(f"  {'':8}{'a pose':>8}{'good':>8}   error where good: cm and degrees, median (p10 to p90)")
    for side, rows in (("COLMAP", colmap), ("ours", ours)):
        good = rows[rows["good"]]
        sides[side] = {
            "poses": int(rows["localized"].sum()),
            "good": len(good),
            "error_m_where_good": bench_scenes.spread(good["error_m"]),
            "error_deg_where_good": bench_scenes.spread(good["error_deg"]),
            "error_m_where_both_good": bench_scenes.spread(rows.loc[both, "error_m"]),
            "error_deg_where_both_good": bench_scenes.spread(rows.loc[both, "error_deg"]),
        }
        centimetres, degrees = (sides[side][f"error_{unit}_where_good"] for unit in ("m", "deg"))
        print(
            f"  {side:8}{sides[side]['poses']:8}{len(good):8}   {bench_scenes.format_spread(centimetres, 2, 100)} cm, "
            f"{bench_scenes.format_spread(degrees, 3)} deg"
        )
    return {"agreement": same, **sides}


def by_distance(distance_m: Float, colmap: pd.DataFrame, ours: pd.DataFrame) -> list[dict[str, float]]:
    """Print and return positives and agreement by the distance to the nearest image of the map."""
    rows = []
    print("\nto the nearest image of the map    views   COLMAP good   ours good   equal")
    for low, high in pairwise(BINS_M):
        inside = (distance_m >= low) & (distance_m < high)
        if not inside.any():
            continue
        a = colmap["good"][inside]
        b = ours["good"][inside]
        row = {"from_m": low, "to_m": high, "views": int(inside.sum()), "colmap": float(a.mean()),
               "ours": float(b.mean()), "equal": float((a == b).mean())}  # fmt: skip
        rows.append(row)
        print(
            f"{low:10.1f} to {high:3.1f} m {'':14}{row['views']:6}{row['colmap']:14.1%}{row['ours']:12.1%}"
            f"{row['equal']:8.1%}"
        )
    return rows


def disagreements(distance_m: Float, n_keypoints: list[int], colmap: pd.DataFrame, ours: pd.DataFrame) -> pd.DataFrame:
    """Print and return the viewpoints whose labels differ."""
    listed = pd.DataFrame({"distance_m": distance_m, "keypoints": n_keypoints})
    for side, rows in (("colmap", colmap), ("ours", ours)):
        listed[f"{side}_cm"] = 100 * rows["error_m"]
        listed[f"{side}_deg"] = rows["error_deg"]
        listed[f"{side}_inliers"] = rows["n_inliers"]
    listed = listed[(colmap["good"] != ours["good"]).to_numpy()]
    print(f"\n{len(listed)} disagreements (NaN: no pose)")
    if len(listed):
        print(listed.to_string(float_format=lambda value: f"{value:.2f}"))
    return listed.rename_axis("viewpoint_id").reset_index()


def report_times(clock: Stopwatch) -> dict[str, Any]:
    """Print and return seconds a viewpoint of both sides, by stage."""
    for seconds in (clock.wall, clock.cpu):
        seconds["match_and_pose"] = [a - b for a, b in zip(seconds["localize"], seconds["extract"], strict=True)]
    report: dict[str, Any] = {}
    print(f"\n{'ms a viewpoint':26}{'wall clock: mean, median (p10 to p90)':>42}{'CPU: mean, median (p10 to p90)':>42}")
    sides = {"COLMAP": STAGES, "ours": ("extract", "match_and_pose")}
    for side, stages in sides.items():
        report[side] = {}
        for stage in (*stages, "total"):
            wall, cpu = clock.totals(stages if stage == "total" else (stage,))
            kinds = {"wall_s": wall, "cpu_s": cpu}
            report[side][stage] = {
                kind: {"mean": float(values.mean()), **bench_scenes.spread(values)} for kind, values in kinds.items()
            }
            shown = [
                f"{1e3 * one['mean']:.1f}, {bench_scenes.format_spread(one, 1, 1e3)}"
                for one in report[side][stage].values()
            ]
            print(f"  {side + ' ' + stage:24}{shown[0]:>42}{shown[1]:>42}")
    report["times_faster"] = {}
    for index, kind in enumerate(("wall", "cpu")):
        theirs, ours = (clock.totals(stages)[index] for stages in sides.values())
        rest = [clock.totals([s for s in stages if s != "extract"])[index].sum() for stages in sides.values()]
        report["times_faster"][kind] = {
            "all": float(theirs.sum() / ours.sum()),
            "without_extraction": float(rest[0] / rest[1]),
            "by_viewpoint": bench_scenes.spread(theirs / ours),
        }
        one = report["times_faster"][kind]
        print(
            f"ours is {one['all']:.1f} times as fast by {kind} time, {one['without_extraction']:.1f} times without "
            f"extraction; by viewpoint {bench_scenes.format_spread(one['by_viewpoint'])}"
        )
    report["once_s"] = {stage: clock.wall[stage][0] for stage in ("copy", "cache", "model")}
    print("once, not counted: " + ", ".join(f"{name} {1e3 * value:.0f} ms" for name, value in report["once_s"].items()))
    return report


def main() -> None:
    parser = bench_scenes.argument_parser(__doc__, views=200)
    parser.add_argument(
        "--extractor", choices=("opencv", "colmap"), default="opencv", help="of the map and of both sides (%(default)s)"
    )
    parser.add_argument("--first-octave", type=int, choices=(-1, 0), default=-1, help="of the extractor (%(default)s)")
    parser.add_argument(
        "--chunk", type=int, default=10, help="viewpoints that COLMAP matches in one call (default: %(default)s)"
    )
    args = parser.parse_args()
    bench_scenes.use_one_thread()

    config = ExtractorConfig(args.extractor, args.first_octave)
    camera = PinholeCamera()
    clock = Stopwatch()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = bench_scenes.open_scene(args.scene, folder, args.seed, args.device)
        renderer = WarpRenderer(scene.mesh, args.device)
        settings = MapConfig(n_images=args.map_images, extractor=config, keep_database=True)
        map_report = build_map(
            scene.mesh, renderer, scene.free_space, camera, settings, args.seed, folder / "map", workers=1
        )
        print(f"{map_report.n_landmarks:,} landmarks from {map_report.n_images} images, SIFT by {args.extractor}")
        true_poses = poses(bench_scenes.viewpoints_anywhere(scene, args.views, args.seed))
        mapped = pycolmap.Reconstruction(str(folder / "map")).images.values()
        mapped_centers = camera_centers(np.stack([image.cam_from_world().matrix() for image in mapped]))
        distance_m = np.linalg.norm(camera_centers(true_poses)[:, None] - mapped_centers, axis=-1).min(1)

        images = (renderer.render(camera, pose[None]).rgb[0] for pose in true_poses)
        ours, keypoints = label_by_localizer(
            Localizer(Landmarks.load(folder / "map" / "landmarks.npz"), camera, extractor=config),
            tqdm(images, "ours", total=len(true_poses), unit="view"),
            true_poses,
            clock,
        )
        colmap = ColmapRegistration(folder / "map", folder, clock, args.seed)
        default, lenient = label_by_colmap(colmap, keypoints, true_poses, clock, args.chunk)

    n_keypoints = [len(one) for one in keypoints]
    report = {
        "settings": {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()},
        "n_landmarks": map_report.n_landmarks,
        "keypoints": bench_scenes.spread(n_keypoints),
        "colmap_default": compare("COLMAP's defaults", default, ours),
        "colmap_few_inliers": compare(f"COLMAP with {FEW_INLIERS} inliers, as ours", lenient, ours),
        "by_distance": by_distance(distance_m, default, ours),
        "disagreements": disagreements(distance_m, n_keypoints, default, ours).to_dict("records"),
        "times": report_times(clock),
    }
    bench_scenes.write_report(args.out, report)


if __name__ == "__main__":
    main()
