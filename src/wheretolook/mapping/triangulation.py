"""Extract keypoints of images, choose pairs to match, match them, and triangulate landmarks with COLMAP."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing
from itertools import tee
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from tqdm.auto import tqdm

from wheretolook.features.extractor import SIFT, DescriptorKind, KeypointExtractor, Keypoints, Stored, kind_of
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers, transform
from wheretolook.geometry.similarity import local_origin
from wheretolook.mapping.config import MAX_EPIPOLAR_ERROR_PX, MIN_TRIANGULATION_ANGLE_DEG
from wheretolook.mapping.feature_files import name_kind
from wheretolook.mapping.map_folder import MapRun, color_points
from wheretolook.utils.files import storing_in_database, temporary_folder
from wheretolook.utils.processes import WorkerPool
from wheretolook.utils.texts import LOG, quiet_colmap

DEPTH_STRIDE = 4  # of the pixels of depth images that are used, at index 2 of each 4 x 4 block
_PAIRS_AT_A_TIME = 64  # pairs in one job of a worker process
MatchJob = tuple[NDArray[np.int64], list[Stored], Path, DescriptorKind]


def image_name(index: int) -> str:
    """File name of the image with an index from 0; its id in COLMAP is `index` + 1."""
    return f"{index:05d}.png"


def extract_with_colors(
    images: Iterable[NDArray[np.uint8]], n_images: int, title: str, run: MapRun, same_size: bool = True
) -> Iterator[tuple[Stored, NDArray[np.uint8]]]:
    """Extract keypoints of images (H, W, 3) uint8, in their order, and the colours (N, 3) uint8 at them.

    The images are made while others are processed. A GPU processes batches if all images are of the same size.
    """
    extractor = KeypointExtractor(run.config.extractor, run.device)
    kind = kind_of(run.config.extractor.method)
    images, waiting = tee(images)
    extracted: Generator[Keypoints, None, None]
    if extractor.on_gpu and not same_size:
        extracted = (extractor.extract(rgb) for rgb in images)
    else:
        extracted = extractor.extract_many(images, run.processes)
    bar = tqdm(extracted, title, total=n_images, disable=not run.progress, unit="image")
    with closing(extracted):
        for keypoints, rgb in zip(bar, waiting, strict=True):
            column, row = keypoints.pixels.astype(np.int64).T
            color = rgb[np.clip(row, 0, rgb.shape[0] - 1), np.clip(column, 0, rgb.shape[1] - 1)]
            yield (keypoints.pixels, kind.store(keypoints.descriptors)), color


def posed_model(camera: PinholeCamera, cam_from_world: NDArray[np.floating[Any]]) -> Any:
    """Make a reconstruction of images of one camera at poses (I, 3, 4), without keypoints; image i has the id i + 1."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **camera.colmap.record()))
    for index, pose in enumerate(np.asarray(cam_from_world, dtype=np.float64)):
        image = pycolmap.Image(name=image_name(index), camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    return model


def triangulate_model(
    database: Path,
    model: Any,
    stored: Sequence[Stored],
    colors: Sequence[NDArray[np.uint8]],
    pairs: NDArray[np.int64],
    run: MapRun,
) -> Any:
    """Match pairs of images, verify the matches against the known poses, and triangulate.

    Makes a COLMAP database of keypoints, descriptors, matches and verified matches. Takes a `pycolmap.Reconstruction`
    of images with poses, which stay as they are, and no points, image i with the id i + 1; keypoints and their colours
    (N_i, 3) uint8 of each image, and pairs (P, 2) of images to match, i < j.

    Returns a `pycolmap.Reconstruction`, not yet filtered by reprojection error.
    """
    clock = run.clock
    folder = database.parent
    kind = kind_of(run.config.extractor.method)
    origin = local_origin([image.projection_center() for image in model.images.values()])
    to_local = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.eye(3)), -origin)
    model.transform(to_local)  # rays that meet far from the origin are ill-conditioned
    seed = run.seed % 2**31  # COLMAP keeps it in an int
    pycolmap.set_random_seed(seed)
    with storing_in_database(database):
        with clock("database"):
            for index, (pixels, _) in enumerate(stored):
                points = [pycolmap.Point2D(p) for p in pixels.astype(np.float64)]
                model.images[index + 1].points2D = pycolmap.Point2DList(points)
            fill_database(database, model, stored, kind)
        with clock("match"):
            matches = match_pairs(stored, pairs, folder, run.processes, run.progress, kind)
            write_matches(database, pairs, matches, sorted(model.images))
        with clock("verify"), quiet_colmap():
            verification = pycolmap.TwoViewGeometryOptions()
            verification.ransac.max_error = MAX_EPIPOLAR_ERROR_PX
            verification.ransac.random_seed = seed
            pycolmap.guided_geometric_verification(
                model, str(database), two_view_geometry_options=verification, num_threads=run.processes.workers
            )
    with clock("triangulate"), quiet_colmap("ERROR"):  # it warns of every image it cannot read colours from
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1, extract_colors=False)
        options.load_all_images = True
        options.triangulation.random_seed = options.mapper.random_seed = seed
        options.triangulation.ignore_two_view_tracks = not run.config.two_view_landmarks
        options.triangulation.min_angle = options.mapper.filter_min_tri_angle = MIN_TRIANGULATION_ANGLE_DEG
        model = pycolmap.triangulate_points(model, str(database), str(folder), str(folder), options=options)
        model.transform(to_local.inverse())
        model.update_point_3d_errors()
    with clock("color"):
        color_points(model, dict(enumerate(colors, 1)))
    return model


def estimate_poses(model: Any) -> None:
    """Adjust poses, focal length and points of a triangulated reconstruction in place, and align it with its old poses.

    Images that observe no point only follow the alignment. A model without points is left as it is.
    """
    images = [image for image in model.images.values() if image.num_points3D]
    if not images:
        return
    before = _frames(images)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_extra_params=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1  # some tracks are wrong
    options.ceres.solver_options.num_threads = 1  # for equal bytes
    adjusted = pycolmap.BundleAdjustmentConfig()
    for image in images:
        adjusted.add_image(image.image_id)
    pycolmap.create_default_bundle_adjuster(options, adjusted, model).solve()
    to_frame = pycolmap.estimate_sim3d(_frames(images), before)
    if to_frame is not None:
        model.transform(to_frame)
    model.update_point_3d_errors()


def _frames(images: Sequence[Any]) -> NDArray[np.float64]:
    """Return the centres of cameras and points 1 m from them along their axes, (4 I, 3)."""
    ends = np.stack([image.cam_from_world().inverse().matrix().T for image in images])
    ends[:, :3] += ends[:, 3:]
    return ends.reshape(-1, 3)


def write_matches(
    database: Path, pairs: NDArray[np.int64], matches: Iterable[NDArray[np.uint32]], ids: Sequence[int]
) -> None:
    """Write matches (M, 2) of each pair (P, 2) of rows of images with these ids into a COLMAP database."""
    with pycolmap.Database.open(str(database)) as db:
        for (i, j), matched in zip(pairs.tolist(), matches, strict=True):
            db.write_matches(ids[i], ids[j], matched)


def match_pairs(
    stored: Sequence[Stored],
    pairs: NDArray[np.int64],
    folder: Path,
    processes: WorkerPool,
    progress: bool = True,
    kind: DescriptorKind = SIFT,
) -> Generator[NDArray[np.uint32], None, None]:
    """Match pairs (P, 2) of images without geometric verification; yields (M, 2) indices of keypoints for each pair.

    SIFT is matched by COLMAP, learned features by `SimilarityMatcher`. Uses processes, not threads: pycolmap's BLAS is
    built without locks, so that two threads sometimes get the same buffer and wrong nearest neighbours. `folder` holds
    small temporary databases.
    """
    bar = tqdm(total=len(pairs), desc="map: match", disable=not progress, unit="pair")
    with bar, temporary_folder(".partial", parent=folder) as work:  # removes what a killed process leaves
        jobs = (
            _match_job(pairs[start : start + _PAIRS_AT_A_TIME], stored, work, kind)
            for start in range(0, len(pairs), _PAIRS_AT_A_TIME)
        )
        for matches in processes.map(_run_match_job, jobs):
            yield from matches
            bar.update(len(matches))


def _match_job(pairs: NDArray[np.int64], stored: Sequence[Stored], folder: Path, kind: DescriptorKind) -> MatchJob:
    """Pairs (P, 2) renumbered to index the keypoints of their own images, these keypoints, and a working folder."""
    images, renumbered = np.unique(pairs, return_inverse=True)
    return renumbered.reshape(-1, 2), [stored[i] for i in images], folder, kind


def _run_match_job(job: MatchJob) -> list[NDArray[np.uint32]]:
    """Match the pairs of a job: (M, 2) indices of keypoints for each."""
    pairs, stored, parent, kind = job
    if not kind.in_bytes:
        return _match_by_similarity(pairs, stored, kind)

    matching = pycolmap.FeatureMatchingOptions(num_threads=1, skip_geometric_verification=True)
    with temporary_folder(parent=parent) as folder:
        database = folder / "database.db"
        listed = folder / "pairs.txt"
        # Any camera and poses do: only verification would use them.
        fill_database(database, posed_model(PinholeCamera(), np.tile(np.eye(3, 4), (len(stored), 1, 1))), stored)
        listed.write_text("".join(f"{image_name(i)} {image_name(j)}\n" for i, j in pairs))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listed))
        with quiet_colmap():
            pycolmap.match_image_pairs(str(database), matching, pairing, device=pycolmap.Device.cpu)
        with pycolmap.Database.open(str(database)) as db:
            return [db.read_matches(i + 1, j + 1) for i, j in pairs.tolist()]


def _match_by_similarity(
    pairs: NDArray[np.int64], stored: Sequence[Stored], kind: DescriptorKind
) -> list[NDArray[np.uint32]]:
    """Match mutual nearest neighbours: (M, 2) indices of keypoints for each pair."""
    from wheretolook.features.learned import one_thread
    from wheretolook.features.matching import SimilarityMatcher

    results = []
    with one_thread():
        for i, j in pairs.tolist():
            matches = SimilarityMatcher(stored[j][1]).match([stored[i][1]], kind.min_similarity)
            results.append(np.column_stack(matches[0][:2]).astype(np.uint32))
    return results


def fill_database(database: Path, model: Any, stored: Iterable[Stored], kind: DescriptorKind = SIFT) -> None:
    """Write a COLMAP database of a reconstruction's cameras and images, and their keypoints in the order of ids.

    Descriptors that are not bytes are stored in single precision, as COLMAP 4 does.
    """
    colmap_type = pycolmap.FeatureExtractorType(kind.colmap_type)
    with pycolmap.Database.open(str(database)) as db:
        for camera in model.cameras.values():
            db.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            db.write_rig(rig, use_rig_id=True)
        for frame in model.frames.values():
            db.write_frame(frame, use_frame_id=True)
        for image_id, (pixels, descriptors) in zip(sorted(model.images), stored, strict=True):
            db.write_image(model.images[image_id], use_image_id=True)
            db.write_keypoints(image_id, pixels)
            if not kind.in_bytes:
                descriptors = descriptors.astype("<f4").view(np.uint8).reshape(len(descriptors), kind.columns)
            db.write_descriptors(image_id, pycolmap.FeatureDescriptors(colmap_type, descriptors))
    if kind is not SIFT:
        name_kind(database, kind)


def shrink_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Subsample depth images (..., H, W) by `DEPTH_STRIDE`, for `surface_overlap`."""
    half = DEPTH_STRIDE // 2
    return depth_m[..., half::DEPTH_STRIDE, half::DEPTH_STRIDE].copy()


def surface_overlap(
    camera: PinholeCamera, cam_from_world: NDArray[np.floating[Any]], depth_m: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Share (I, I) of the surface in one image that another image also sees, similarly enough to be matched.

    Takes poses (I, 3, 4) and z-depth (I, h, w) from `shrink_depth`, 0 where there is none. A point counts if the other
    image's depth agrees with it (5 %), if the rays of the two images meet at 1 to 55 degrees, and if their depths
    differ by less than a factor of 2.5. Returns the mean of both directions; 0 on the diagonal.
    """
    n, h, w = depth_m.shape
    step = max(1, w // 16)
    grid = np.meshgrid(np.arange(step // 2, h, step), np.arange(step // 2, w, step), indexing="ij")
    rows, columns = (axis.ravel() for axis in grid)
    pixels = np.column_stack([columns, rows]) * DEPTH_STRIDE + DEPTH_STRIDE // 2 + 0.5
    rays = np.column_stack([(pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(len(pixels))])
    depth = depth_m[:, rows, columns].astype(np.float64)
    centers = camera_centers(cam_from_world)
    points = centers[:, None] + depth[..., None] * (rays @ np.asarray(cam_from_world)[:, :, :3])
    seen_from = points - centers[:, None]
    seen_from /= np.maximum(np.linalg.norm(seen_from, axis=-1, keepdims=True), 1e-9)
    closest, farthest = np.cos(np.radians((1.0, 55.0)))  # less triangulates badly, more does not match
    share = np.zeros((n, n))
    for j in range(n):
        in_j = transform(cam_from_world[j], points.reshape(-1, 3)).reshape(points.shape)
        pixel = camera.project(in_j)
        z = in_j[..., 2]
        inside = (z > 0) & camera.in_image(pixel) & (depth > 0)
        index = np.where(inside[..., None], pixel, 0).astype(np.int64) // DEPTH_STRIDE
        there = depth_m[j, np.minimum(index[..., 1], h - 1), np.minimum(index[..., 0], w - 1)]
        ray = points - centers[j]
        cosine = (ray * seen_from).sum(-1) / np.maximum(np.linalg.norm(ray, axis=-1), 1e-9)
        shared = inside & (np.abs(there - z) < 0.05 * z) & (cosine > farthest) & (cosine < closest)
        shared &= (z < 2.5 * depth) & (depth < 2.5 * z)  # scales differ too much beyond
        share[:, j] = shared.mean(1)
    np.fill_diagonal(share, 0)
    return (share + share.T) / 2


def choose_pairs(overlap: NDArray[np.float64], partners: int, min_overlap: float = 0.05) -> NDArray[np.int64]:
    """Choose pairs (P, 2) of each image with its `partners` images of largest overlap; i < j, sorted, each pair once.

    `overlap` (I, I) is symmetric; pairs below `min_overlap` are omitted. An image can be in more than `partners` pairs,
    since others choose it, too.
    """
    best = np.argsort(-overlap, axis=1, kind="stable")[:, :partners]
    first = np.repeat(np.arange(len(overlap)), best.shape[1])
    second = best.ravel()
    good = overlap[first, second] >= max(min_overlap, np.finfo(float).tiny)
    pairs = np.sort(np.column_stack([first, second])[good], axis=1)
    return np.unique(pairs, axis=0).reshape(-1, 2)


def photograph_pairs(
    stored: Sequence[Stored], kind: DescriptorKind, exhaustive_up_to: int, overlap: int, partners: int = 20
) -> NDArray[np.int64]:
    """Choose pairs (P, 2) of n photographs to match, i < j: all pairs, if n does not exceed `exhaustive_up_to`.

    Otherwise each with the `partners` whose global descriptors are most similar. Where names are in the order of
    capture, so that the next photograph mostly is among the `overlap` most similar, also with the `overlap` that follow
    and as many at distances that double, as COLMAP's sequential matching does.
    """
    n = len(stored)
    if n <= exhaustive_up_to:
        return np.column_stack(np.triu_indices(n, 1)).astype(np.int64)
    descriptors = global_descriptors(stored, kind)
    similarity = (descriptors @ descriptors.T).astype(np.float64)
    np.fill_diagonal(similarity, -1)
    pairs = choose_pairs(similarity, partners, 0.0)
    rank_of_next = (similarity[:-1] > np.diagonal(similarity, 1)[:, None]).sum(1)
    in_order = np.median(rank_of_next) < overlap
    by_name = "also with its neighbours by name" if in_order else "not by name, which is not the order of capture"
    LOG.info("%d photographs: each is matched with the %d most similar, %s", n, partners, by_name)
    if in_order:
        steps = sorted({*range(1, overlap + 1), *(2**power for power in range(overlap))})
        following = [np.column_stack([np.arange(n - step), np.arange(step, n)]) for step in steps if step < n]
        pairs = np.unique(np.concatenate([pairs, *following]), axis=0)
    return pairs


def global_descriptors(stored: Sequence[Stored], kind: DescriptorKind, n_words: int = 64) -> NDArray[np.float32]:
    """Compute a descriptor (I, n_words * D) of unit length of each image from its local ones, less the mean of all.

    It is VLAD (Jegou et al., CVPR 2010) with normalized words (Arandjelovic and Zisserman, CVPR 2013) that are trained
    on these images.
    """
    n_sampled = max(100, 20_000 // len(stored))  # of each image: k-means takes seconds
    rng = np.random.default_rng(0)
    samples = [descriptors[rng.permutation(len(descriptors))[:n_sampled]] for _, descriptors in stored]
    words = kmeans2(kind.restore(np.concatenate(samples)), n_words, minit="points", rng=rng)[0].astype(np.float32)
    of_images = np.zeros((len(stored), n_words, words.shape[1]), dtype=np.float32)
    for image, (_, descriptors) in enumerate(stored):
        values = kind.restore(descriptors)
        nearest = (values @ words.T - (words**2).sum(1) / 2).argmax(1)
        of_word = (nearest[:, None] == np.arange(n_words)).astype(np.float32)
        of_images[image] = of_word.T @ values - of_word.sum(0)[:, None] * words
    of_images /= np.maximum(np.linalg.norm(of_images, axis=2, keepdims=True), 1e-9)
    flat = of_images.reshape(len(stored), -1)
    flat -= flat.mean(0)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9), dtype=np.float32)
