"""Export the network, landmarks and camera that `wheretolook_robot.py` scores views with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.thresholds import Accuracy, checked_accuracy
from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera, describe_camera
from wheretolook.geometry.poses import Float
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.set.own_images import for_map
from wheretolook.scorers.set.score import MAX_LANDMARKS
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.training_range import camera_quantities
from wheretolook.utils.errors import CameraError
from wheretolook.utils.files import copy_file, sha256, write_bytes, write_json
from wheretolook.utils.npz_files import save_npz
from wheretolook.utils.version import VERSION

FORMAT_VERSION = 1  # of the folder, as in wheretolook_robot.py
RECTIFIED = {"SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}
"""Number of focal lengths of COLMAP's perspective models with distortion."""
BLOCK = 64  # locations per call of the occlusion model


def export_robot(
    localization_map: LocalizationMap,
    weights: str | Path,
    out: str | Path,
    places: Float | None = None,
    progress: bool = True,
    accuracy: Accuracy | None = None,
) -> Path:
    """Write scorer.onnx, landmarks.npz, robot.json and wheretolook_robot.py, which documents them, into a folder.

    Args:
        localization_map: landmarks and a pinhole camera.
        weights: weights of the method `set`.
        out: folder; existing files are replaced.
        places: (L, 3) m, locations whose occlusion is stored; None for no occlusion.
        progress: show a bar.
        accuracy: limits of the errors in metres and degrees that the scores refer to; None for those of the weights.

    Returns:
        The folder.

    Raises:
        CameraError: the camera is not a pinhole.
        WeightsError: the weights are not of the method `set`, or are damaged.
    """
    camera = localization_map.camera
    if not isinstance(camera, PinholeCamera):
        fix = "Give the pinhole of the robot's rectified images."
        raise CameraError("a robot's camera must be a pinhole", value=describe_camera(camera), fix=fix)
    from wheretolook.robot.graph import set_graph

    out = Path(out)
    weights = Path(weights)
    trained = TrainedNetwork.load(weights, SetNetwork, "set")
    trained.network.to(localization_map.device)
    trained = for_map(trained, localization_map)
    landmarks = localization_map.landmarks
    places = np.empty((0, 3)) if places is None else np.asarray(places, dtype=np.float64).reshape(-1, 3)
    accuracy = trained.accuracy if accuracy is None else checked_accuracy(accuracy)
    content = set_graph(trained, accuracy).SerializeToString()
    arrays: dict[str, NDArray[Any]] = {
        "points": landmarks.points,
        "directions": landmarks.mapping_direction,
        "attributes": landmarks.attributes(),
        "places": places,
        "unoccluded": _unoccluded(localization_map, places, progress),
    }
    about = {
        "n_landmarks": len(landmarks),
        "weights_sha256": sha256(weights),
        **_description(trained, camera, accuracy),
    }
    about["world_from_map"] = localization_map.frame.world_from_map.record()
    write_bytes(out / "scorer.onnx", content)
    save_npz(out / "landmarks.npz", arrays)
    copy_file(Path(__file__).with_name("wheretolook_robot.py"), out / "wheretolook_robot.py")
    write_json(out / "robot.json", about)
    return out


def _description(trained: TrainedNetwork[SetNetwork], camera: PinholeCamera, accuracy: Accuracy) -> dict[str, Any]:
    """Describe camera, inputs, accuracy and training range of a network for robot.json."""
    training_range = trained.range_at(accuracy)
    return {
        "format_version": FORMAT_VERSION,
        "wheretolook": VERSION,
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "attributes": list(trained.network.attributes),
        "map_attributes": list(MAP_ATTRIBUTES),
        "most": MAX_LANDMARKS,
        "accuracy": list(accuracy),
        "range": training_range.record(),
        "serves_camera": bool(training_range.contains(camera_quantities(camera)[None])[0]),
    }


def pinhole_of(camera: Camera) -> PinholeCamera:
    """Return the pinhole of a camera's rectified images: same size, focal lengths and principal point.

    Raises CameraError for fisheyes and panoramas.
    """
    if isinstance(camera, PinholeCamera):
        return camera
    if isinstance(camera, ColmapCamera) and camera.model in RECTIFIED:
        focal = camera.params[: RECTIFIED[camera.model]]
        return PinholeCamera(camera.width, camera.height, focal[0], focal[-1], camera.principal_point)
    fix = "Give the pinhole of the robot's rectified images by --camera."
    raise CameraError("this camera model has no pinhole", value=describe_camera(camera), fix=fix)


def _unoccluded(localization_map: LocalizationMap, places: Float, progress: bool) -> np.ndarray:
    """Compute bits (L, ceil(N / 8)) uint8 of the landmarks that are unoccluded from places (L, 3) m."""
    points = localization_map.landmarks.points
    packed = np.empty((len(places), (len(points) + 7) // 8), dtype=np.uint8)
    hidden = not progress or len(places) == 0
    for begin in tqdm(range(0, len(places), BLOCK), desc="occlusion", unit=f"{BLOCK} places", disable=hidden):
        rows = slice(begin, begin + BLOCK)
        packed[rows] = np.packbits(localization_map.occlusion.unoccluded(places[rows], points), axis=1)
    return packed
