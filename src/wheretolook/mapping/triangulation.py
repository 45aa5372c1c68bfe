"""Matching and triangulation with known poses in COLMAP."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry import PinholeCamera
from wheretolook.mapping.colmap_model import quiet_colmap
from wheretolook.mapping.extraction import Keypoints, quantize_descriptors

_PAIRS_AT_A_TIME = 64  # a step of the progress bar


def image_name(index: int) -> str:
    """File name of the map's image number `index`, from 0. Its id in COLMAP is `index` + 1."""
    return f"{index:05d}.png"


def triangulate_known_poses(
    database: Path,
    camera: PinholeCamera,
    cam_from_world: NDArray[np.floating[Any]],
    keypoints: Sequence[Keypoints],
    colors: Sequence[NDArray[np.uint8]],
    pairs: NDArray[np.int64],
    clock: Callable[[str], AbstractContextManager[None]],
    max_epipolar_error_px: float = 2.0,
    min_triangulation_angle_deg: float = 1.5,
    two_view_landmarks: bool = False,
    seed: int = 0,
    workers: int = 1,
    progress: bool = True,
) -> Any:
    """Match pairs of images, verify the matches against the known poses, and triangulate.

    Args:
        database: COLMAP database to make; gets keypoints, descriptors, matches and verified matches.
        camera: intrinsics of all images.
        cam_from_world: (I, 3, 4) poses, kept as they are.
        keypoints: of the I images.
        colors: (N_i, 3) uint8 colours of the keypoints.
        pairs: (P, 2) indices of the images to match, i < j.
        clock: times a step.
        max_epipolar_error_px: matches farther from the epipolar line are dropped.
        min_triangulation_angle_deg: points whose rays meet at less are not made.
        two_view_landmarks: whether two observations make a point.
        seed: of COLMAP's sampling.
        workers: threads.
        progress: show a progress bar.

    Returns:
        A `pycolmap.Reconstruction`, not filtered by reprojection error yet.
    """
    import pycolmap

    seed %= 2**31  # COLMAP keeps it in an int
    pycolmap.set_random_seed(seed)
    with clock("database"):
        model = _posed_model(camera, cam_from_world, keypoints)
        _fill_database(database, model, keypoints)
    with clock("match"):
        matching = pycolmap.FeatureMatchingOptions(num_threads=workers, skip_geometric_verification=True)
        listed = database.with_suffix(".pairs.txt")
        with quiet_colmap(), tqdm(total=len(pairs), desc="map: match", disable=not progress, unit="pair") as bar:
            for start in range(0, len(pairs), _PAIRS_AT_A_TIME):
                chunk = pairs[start : start + _PAIRS_AT_A_TIME]
                listed.write_text("".join(f"{image_name(i)} {image_name(j)}\n" for i, j in chunk))
                pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listed))
                pycolmap.match_image_pairs(str(database), matching, pairing, device=pycolmap.Device.cpu)
                bar.update(len(chunk))
        listed.unlink(missing_ok=True)
    with clock("verify"):
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.max_error = max_epipolar_error_px
        verification.ransac.random_seed = seed
        with quiet_colmap():
            pycolmap.guided_geometric_verification(
                model, str(database), two_view_geometry_options=verification, num_threads=workers
            )
    with clock("triangulate"):
        options = pycolmap.IncrementalPipelineOptions(
            random_seed=seed, num_threads=1, extract_colors=False, load_all_images=True
        )
        options.triangulation.random_seed = options.mapper.random_seed = seed
        options.triangulation.ignore_two_view_tracks = not two_view_landmarks
        options.triangulation.min_angle = options.mapper.filter_min_tri_angle = min_triangulation_angle_deg
        folder = database.parent
        with quiet_colmap("ERROR"):  # it warns of every image it cannot read colours from
            model = pycolmap.triangulate_points(model, str(database), str(folder), str(folder), options=options)
        model.update_point_3d_errors()
    with clock("color"):
        for point in model.points3D.values():
            seen = [colors[e.image_id - 1][e.point2D_idx] for e in point.track.elements]
            point.color = np.rint(np.mean(seen, axis=0)).astype(np.uint8)
    return model


def _posed_model(
    camera: PinholeCamera, cam_from_world: NDArray[np.floating[Any]], keypoints: Sequence[Keypoints]
) -> Any:
    import pycolmap

    model = pycolmap.Reconstruction()
    parameters = [camera.focal_px, camera.cx, camera.cy]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1, model="SIMPLE_PINHOLE", width=camera.width, height=camera.height, params=parameters
        )
    )
    for index, pose in enumerate(np.asarray(cam_from_world, dtype=np.float64)):
        image = pycolmap.Image(name=image_name(index), camera_id=1, image_id=index + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(p) for p in keypoints[index].pixels.astype(np.float64)])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
        model.add_image_with_trivial_frame(image, pose)
    return model


def _fill_database(database: Path, model: Any, keypoints: Sequence[Keypoints]) -> None:
    import pycolmap

    with pycolmap.Database.open(str(database)) as db:
        for camera in model.cameras.values():
            db.write_camera(camera, use_camera_id=True)
        for rig in model.rigs.values():
            db.write_rig(rig, use_rig_id=True)
        for image_id in sorted(model.images):
            image = model.images[image_id]
            db.write_frame(image.frame, use_frame_id=True)
            db.write_image(image, use_image_id=True)
            found = keypoints[image_id - 1]
            db.write_keypoints(image_id, found.pixels)
            data = pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, quantize_descriptors(found.descriptors)
            )
            db.write_descriptors(image_id, data)
