"""Export a set network to ONNX, from the landmarks of views to the probability that they localize."""

from __future__ import annotations

import ast
import io
import json
import warnings
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import asdict, replace
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import logsigmoid
from tqdm.auto import tqdm

import wheretolook
from wheretolook.dataset.config import Accuracy, checked_accuracy
from wheretolook.features.extractor import SIFT
from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera, describe_camera
from wheretolook.geometry.poses import Float
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES, Landmarks
from wheretolook.robot.wheretolook_robot import FILES, FORMAT_VERSION, description_digest, file_digest
from wheretolook.scorers.set.accuracy import model_of, statistics_on
from wheretolook.scorers.set.network import CELLS, SetNetwork, ViewSums, expected_parts
from wheretolook.scorers.set.score import MAX_LANDMARKS, for_map
from wheretolook.training.trained_network import TrainedNetwork, camera_quantities
from wheretolook.utils.errors import CameraError, MapError
from wheretolook.utils.files import atomic_write, copy_file, save_npz, sha256, write_bytes, write_json, write_text
from wheretolook.utils.package import VERSION


def pose_variances(information: Tensor) -> Tensor:
    """Invert information matrices (B, 6, 6) by Gauss-Jordan elimination, since ONNX has no Cholesky decomposition.

    Returns the diagonals of the inverses (B, 6). Positive definite matrices need no pivoting.
    """
    unit = torch.eye(6, dtype=information.dtype)
    rows = torch.cat([information, unit.expand_as(information)], dim=-1)
    for k in range(6):
        pivot = rows[:, k, k]
        row = (rows[:, k] / pivot[:, None])[:, None]
        rows = torch.where(unit[k, :, None] > 0, row, rows - rows[:, :, k, None] * row)
    return (rows[:, :, 6:] * unit).sum(-1)


def log_ndtr(x: Tensor) -> Tensor:
    """Return the log of the standard normal distribution function at x (...), which ONNX lacks.

    By a polynomial in the log of half the complementary error function, within 1.2e-7 (Numerical Recipes in C, 6.2).
    """
    falling = (0.17087277, -0.82215223, 1.48851587, -1.13520398, 0.27886807)
    coefficients = (*falling, -0.18628806, 0.09678418, 0.37409196, 1.00002368, -1.95865941)
    t = 1 / (1 + x.abs() / sqrt(8))
    polynomial = torch.zeros_like(t)
    for coefficient in coefficients:
        polynomial = polynomial * t + coefficient
    below = t.log() - x * x / 2 + polynomial  # at -|x|
    return torch.where(x > 0, torch.log1p(-below.exp()), below)


class RobotNetwork(nn.Module):
    """A calibrated set network, with probabilities at an accuracy, on views padded with landmarks that are not theirs."""

    borders: Tensor

    def __init__(self, trained: TrainedNetwork[SetNetwork], accuracy: Accuracy) -> None:
        super().__init__()
        self.accuracy = accuracy
        self.network = deepcopy(trained.network).cpu().eval()
        self.network.pose_variances = pose_variances
        self.trained = replace(trained, network=self.network)
        # tangents of the borders of the cells, rounded up, so that no rounding of an arctangent decides
        exact = np.tan((np.arange(1, CELLS) / CELLS - 0.5) * np.pi)
        single = exact.astype(np.float32)
        single = np.where(single < exact, np.nextafter(single, np.float32(np.inf)), single)
        self.register_buffer("borders", torch.from_numpy(single))

    def forward(self, values: Tensor, n_sampled: Tensor, n_visible: Tensor) -> tuple[Tensor, Tensor]:
        """Score B views.

        Args:
            values: (B, K, A) float32, attributes of at most K landmarks of each view.
            n_sampled: (B,) int64, number of these landmarks that are the view's.
            n_visible: (B,) int64, number of visible landmarks.

        Returns:
            Probabilities to localize (B,) float64 and expected inliers (B,) float32.
        """
        network = self.network
        log_odds = network.matchability(values)
        own = torch.arange(values.shape[1]) < n_sampled[:, None]
        each = (n_visible.double() / n_sampled.clamp(min=1))[:, None]  # visible landmarks per sampled one
        sums = (expected_parts(values, log_odds, network.attributes).double() * own[..., None]).sum(1) * each
        views = ViewSums(sums, n_visible, self._expected_cells(values, log_odds, own, each))
        probability = self.trained.calibrated(network.logits(views).double()).sigmoid()
        statistics = statistics_on(self.trained, views)
        limits = self.accuracy, self.trained.accuracy
        probability = model_of(self.trained).at(*limits, probability, statistics, torch, log_ndtr)
        return probability, sums[:, 0].float()

    def _expected_cells(self, values: Tensor, log_odds: Tensor, own: Tensor, each: Tensor) -> Tensor:
        """Compute `expected_cells` (B,) of padded views."""
        column, row = (
            (values[..., self.network.attributes.index(name), None] >= self.borders).sum(-1)
            for name in ("across", "down")
        )
        missed = torch.where(own, logsigmoid(-log_odds).double(), torch.zeros((), dtype=torch.float64))
        log_missed = torch.zeros(values.shape[0], CELLS**2, dtype=torch.float64)
        log_missed = log_missed.scatter_add(1, row * CELLS + column, missed)
        return (1 - (log_missed * each).exp()).sum(1)


def set_graph(trained: TrainedNetwork[SetNetwork], accuracy: Accuracy) -> Any:
    """Return the `onnx.ModelProto` of a `RobotNetwork`, with its inputs and outputs."""
    example = (torch.zeros(2, 3, len(trained.network.attributes)), torch.tensor([3, 2]), torch.tensor([5, 2]))
    inputs = ("values", "taken", "n_visible")
    outputs = ("probability", "expected_inliers")
    axes = {name: {0: "B"} for name in (*inputs, *outputs)}
    axes["values"] = {0: "B", 1: "K"}
    file: Any = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):  # the default exporter needs another package
        torch.onnx.export(
            RobotNetwork(trained, accuracy),
            example,
            file,
            dynamo=False,
            opset_version=17,  # of 2022: onnxruntime 1.12 and later reads the file
            input_names=inputs,
            output_names=outputs,
            dynamic_axes=axes,
        )
    model = onnx.load_from_string(file.getvalue())
    model.ir_version = 8
    onnx.checker.check_model(model, full_check=True)
    return model


PACKAGE = "wheretolook_localization"  # of the copies, so that an installed wheretolook does not replace them
ROOT = Path(wheretolook.__file__).parent


def export_localizer(landmarks: Landmarks, ids: NDArray[np.int64], mean_scores: Float, out: Path) -> None:
    """Write the localizer into a robot's folder: the package `PACKAGE`, descriptors.npy of the landmarks with ids (N,),
    and mean_scores.npy, of `wheretolook.looks.next_look.mean_scores_by_pitch`.

    Raises MapError unless these landmarks have SIFT descriptors.
    """
    if landmarks.descriptors is None or landmarks.features != SIFT.name:
        fix = "Give --database with SIFT descriptors, or leave --localize out."
        raise MapError("a robot localizes by SIFT descriptors", value=landmarks.features or "none", fix=fix)
    known = np.isin(landmarks.ids, ids)
    if known.sum() != len(ids):
        raise MapError(
            "the descriptors are of other landmarks", value=f"{known.sum()} of {len(ids)}", fix="Give --database."
        )
    for name, array in (("descriptors", landmarks.descriptors[known]), ("mean_scores", mean_scores)):
        with atomic_write(out / f"{name}.npy") as partial, partial.open("wb") as file:
            np.save(file, array)
    folder = out / PACKAGE
    for name in _modules():
        path = _path(name)
        assert path is not None
        text = path.read_text(encoding="utf-8").replace("from wheretolook.", f"from {PACKAGE}.")
        write_text(folder / path.relative_to(ROOT), text)
    write_text(folder / "__init__.py", f"from {PACKAGE}.robot.localizer import ImageSequence, RobotLocalizer\n")
    for name in ("confidence.json", "missing.json"):
        copy_file(ROOT / "localization" / name, folder / "localization" / name)


def _path(module: str) -> Path | None:
    """Return the file of a module of this package, None for other names."""
    path = ROOT.joinpath(*module.split(".")[1:]).with_suffix(".py")
    return path if path.is_file() else None


def _modules() -> set[str]:
    """Return the names of the modules to copy: the localizer, the planner of views along a path, and what they import."""
    found: set[str] = set()
    left = ["wheretolook.robot.localizer", "wheretolook.planning.view_sequence"]
    while left:
        name = left.pop()
        path = _path(name)
        if name not in found and path is not None:
            found.add(name)
            left.extend(_imports(ast.parse(path.read_text(encoding="utf-8"))))
    return found


def _imports(node: ast.AST) -> Iterator[str]:
    """Yield the modules that code imports, apart from those for types only."""
    if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("wheretolook."):
        yield str(node.module)
    if not (isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"):
        for child in ast.iter_child_nodes(node):
            yield from _imports(child)


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
    about["files"] = {name: file_digest(out / name) for name in FILES if (out / name).is_file()}
    about = json.loads(json.dumps(about))  # with the types that are read
    write_json(out / "robot.json", about | {"sha256": description_digest(about)})
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
        "calibration": None if trained.of_map is None else asdict(trained.of_map),
        "range": training_range.record(),
        "serves_camera": bool(training_range.contains(camera_quantities(camera)[None])[0]),
    }


def pinhole_of(camera: Camera) -> PinholeCamera:
    """Return the pinhole of a camera's rectified images: same size, focal lengths and principal point.

    Raises CameraError for fisheyes and panoramas.
    """
    if isinstance(camera, PinholeCamera):
        return camera
    focal_lengths = {"SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2}  # perspective, with distortion
    if isinstance(camera, ColmapCamera) and camera.model in focal_lengths:
        focal = camera.params[: focal_lengths[camera.model]]
        return PinholeCamera(camera.width, camera.height, focal[0], focal[-1], camera.principal_point)
    fix = "Give the pinhole of the robot's rectified images by --camera."
    raise CameraError("this camera model has no pinhole", value=describe_camera(camera), fix=fix)


def _unoccluded(localization_map: LocalizationMap, places: Float, progress: bool) -> np.ndarray:
    """Compute bits (L, ceil(N / 8)) uint8 of the landmarks that are unoccluded from places (L, 3) m."""
    points = localization_map.landmarks.points
    packed = np.empty((len(places), (len(points) + 7) // 8), dtype=np.uint8)
    hidden = not progress or len(places) == 0
    for begin in tqdm(range(0, len(places), 64), desc="occlusion", unit="64 places", disable=hidden):
        rows = slice(begin, begin + 64)
        packed[rows] = np.packbits(localization_map.occlusion.unoccluded(places[rows], points), axis=1)
    return packed
