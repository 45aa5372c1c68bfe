"""Score camera views on a robot: where to point a camera so that it localizes.

This file needs NumPy and onnxruntime, neither PyTorch nor the rest of wheretolook. `wheretolook export --map SPARSE
--out FOLDER` writes it together with the files it reads:

    scorer.onnx     network from the visible landmarks of a view to the probability that the view localizes within
                    the accuracy in robot.json
    landmarks.npz   map with N landmarks:
        points      (N, 3) float64, metres in the world
        directions  (N, 3) float32, unit mean direction from the mapping cameras to the landmark, in the world
        attributes  (N, M) float32, attributes of each landmark; NaN if unknown
        places      (L, 3) float64, locations with known occlusion; L = 0 without
        unoccluded  (L, ceil(N / 8)) uint8, bits packed by `numpy.packbits`: 1 if the landmark is unoccluded
    robot.json      camera, accuracy in metres and degrees, names of the attributes, range of the training views, the
                    similarity from the map's own frame to the world, and digests of all files

Usage, in that folder:

    from wheretolook_robot import RobotScorer

    scorer = RobotScorer("FOLDER")
    view = scorer.best((1.0, 2.0, 1.5))     # of 500 directions at this location
    view.direction, view.score              # where to look, and the probability to localize
    scorer.score(cam_from_world)            # (B,) for poses (B, 3, 4)

Frames and units. Positions and poses are given and returned in the map's own frame and unit, which a similarity relates
to the world: metres, z up. Pitch is that of the world. The camera's x axis is right, y down, z forward (OpenCV, COLMAP,
the optical frame of ROS). A pose is the matrix `cam_from_world` = [R | t], (3, 4): a point p of the map is at R p + t in the
camera, whose centre is -R^T t. Pixel (0.5, 0.5) is the centre of the top-left pixel. Focal lengths are in pixels,
quaternions are xyzw as in ROS. The camera is a pinhole; for a lens with distortion, that of its rectified images.

Occlusion is not computed here. With `places`, a view sees the landmarks that are unoccluded from the nearest of them
(`ScoredViews.place_distance` is the distance to it). Without, landmarks are visible through walls and scores behind walls are too
high. A robot with a better estimate passes `unoccluded`, (N,) bool.

The computation, in the order of this file: select the landmarks in the image, compute their attributes for the view,
run the network. Scores equal those of wheretolook's PyTorch scorer within 1e-5.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FORMAT_VERSION = 2  # of the folder
FILES = ("landmarks.npz", "scorer.onnx", "descriptors.npy", "mean_scores.npy")
OUTPUTS = ("probability", "expected_inliers")
FREE_BYTES = 128_000_000  # that landmarks.npz may expand to, whatever its size

Array = NDArray[Any]


@dataclass(frozen=True)
class ScoredViews:
    """Scores of B views."""

    score: Array  # (B,) float64, the probability that the view localizes
    n_visible: Array  # (B,) int64, visible landmarks
    expected_inliers: Array  # (B,) float32, expected number of correctly matched landmarks
    in_range: Array  # (B,) bool, whether the view is within the range of the training views
    place_distance: Array  # (B,) float64, to the place whose occlusion was used, in units of the map; NaN without


@dataclass(frozen=True)
class BestView:
    """The best view at a location; fields as in `ScoredViews`."""

    direction: Array  # (3,) unit optical axis in the map
    cam_from_world: Array  # (3, 4) pose without roll
    quaternion_xyzw: Array  # (4,) orientation of the optical frame in the map, as in ROS
    score: float
    n_visible: int
    expected_inliers: float
    in_range: bool
    place_distance: float


def description_digest(about: dict[str, Any]) -> str:
    """Return the SHA-256 of the content of robot.json, apart from this digest."""
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def read_description(folder: Path) -> dict[str, Any]:
    """Read robot.json of a folder, and compare it and the files that it names with the digests of the export.

    Raises OSError if a file is missing, ValueError if one has changed, or if the folder is of another format version.
    """
    path = folder / "robot.json"
    if not path.is_file():  # missing, a folder, device or pipe
        raise FileNotFoundError(f"{path}: no such file. Export again.")
    try:
        if path.stat().st_size > 1_000_000:
            raise ValueError("larger than a megabyte")
        about: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if about["format_version"] != FORMAT_VERSION:
            raise ValueError(f"this program reads format {FORMAT_VERSION}")
        if about.pop("sha256") != description_digest(about):
            raise ValueError("changed since the export")
        digests = {folder / name: about["files"][name] for name in FILES if name in about["files"]}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: the settings cannot be used: {problem}. Export again.") from error
    for file, digest in digests.items():
        if not file.is_file():
            raise FileNotFoundError(f"{file}: no such file. Export again.")
        if file_digest(file) != digest:
            raise ValueError(f"{file}: changed since the export. Export again.")
    return about


class RobotScorer:
    """Scores views of a map exported by `wheretolook export`.

    Args:
        folder: with scorer.onnx, landmarks.npz and robot.json.
        threads: number of threads of the network.

    Raises:
        OSError: a file is missing.
        ValueError: a file has changed since the export, or is of another format version.
    """

    def __init__(self, folder: str | Path, threads: int = 1) -> None:
        import onnxruntime  # which localizing does not need

        folder = Path(folder)
        about = read_description(folder)
        self.camera: dict[str, float] = about["camera"]  # in pixels
        self._names: list[str] = about["attributes"]  # inputs of the network, in its order
        self._map_names: list[str] = about["map_attributes"]  # columns of `attributes`
        self._most: int = about["most"]  # landmarks per view; of more, an even sample
        self._range: dict[str, list[float]] = about["range"]
        self._serves_camera: bool = about["serves_camera"]
        frame = about["world_from_map"]
        self._scale: float = frame["scale"]  # metres in a unit of the map
        self._rotation = np.array(frame["rotation"], dtype=np.float64)
        self._translation = np.array(frame["translation"], dtype=np.float64)
        self._read_landmarks(folder / "landmarks.npz")
        self._columns = np.ascontiguousarray(self.points.T)  # (3, N): contiguous coordinates are faster
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads release the core
        network = str(folder / "scorer.onnx")
        self._session = onnxruntime.InferenceSession(network, options, providers=["CPUExecutionProvider"])

    def _read_landmarks(self, path: Path) -> None:
        """Read landmarks.npz. Raises ValueError if it cannot be read, or would fill the memory."""
        try:
            with np.load(path, allow_pickle=False) as stored:
                n_bytes = sum(member.file_size for member in stored.zip.infolist())
                if n_bytes > max(FREE_BYTES, 100 * path.stat().st_size):
                    raise ValueError(f"it would expand to {n_bytes:,} bytes")
                arrays = {name: stored[name] for name in ("points", "directions", "attributes", "places", "unoccluded")}
                bits = arrays["unoccluded"]
                if bits.dtype != np.uint8 or bits.shape != (len(arrays["places"]), -(-len(arrays["points"]) // 8)):
                    raise ValueError(f"unoccluded is {bits.dtype} of shape {bits.shape}")
        except Exception as error:  # a damaged archive raises errors of many kinds
            raise ValueError(f"{path}: the landmarks cannot be used: {error}. Export again.") from error
        self.points: Array = arrays["points"]
        self._directions = arrays["directions"]
        self._attributes = arrays["attributes"]
        self.places: Array = arrays["places"]
        self._unoccluded = arrays["unoccluded"]

    def score(self, cam_from_world: ArrayLike, unoccluded: ArrayLike | None = None) -> Array:
        """Return the probabilities (B,) that poses (B, 3, 4) localize; see `views`."""
        return self.views(cam_from_world, unoccluded).score

    def views(self, cam_from_world: ArrayLike, unoccluded: ArrayLike | None = None) -> ScoredViews:
        """Score poses (B, 3, 4), or one (3, 4).

        `unoccluded` (N,) bool marks the landmarks that are unoccluded from these poses; by default those of the nearest
        place. Raises ValueError for other shapes or a pose that is not finite.
        """
        poses = np.asarray(cam_from_world, dtype=np.float64)
        poses = poses[None] if poses.ndim == 2 else poses
        if poses.shape[1:] != (3, 4) or not np.isfinite(poses).all():
            raise ValueError(f"cam_from_world must be finite, (B, 3, 4), not {poses.shape}")
        centers = self._to_world(-np.einsum("bji,bj->bi", poses[:, :, :3], poses[:, :, 3]))
        rotations = poses[:, :, :3] @ self._rotation.T
        # consecutive views at one location share what depends on the location
        moved = (np.abs(np.diff(centers, axis=0)) > 1e-8).any(axis=1)
        firsts = [0, *(np.flatnonzero(moved) + 1).tolist(), len(poses)] if len(poses) else []
        parts = [self._views_at(centers[a], rotations[a:b], unoccluded) for a, b in pairwise(firsts)]
        parts = parts or [self._views_at(np.zeros(3), rotations, unoccluded)]
        return ScoredViews(
            *(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(ScoredViews))
        )

    def score_directions(self, locations: ArrayLike, directions: ArrayLike) -> Array:
        """Score views without roll at locations (L, 3) m in the world along each of directions (D, 3). Returns (L, D)."""
        rotations = rotations_looking_along(directions)
        rows = [self._views_at(at, rotations, None).score for at in np.asarray(locations, dtype=np.float64)]
        return np.stack(rows)

    def best(
        self,
        position: ArrayLike,
        directions: int | ArrayLike = 500,
        unoccluded: ArrayLike | None = None,
        pitch_deg: tuple[float, float] = (-90.0, 90.0),
    ) -> BestView:
        """Return the view with the highest score at a position (3,) of the map.

        `directions` are (D, 3), or a number of directions evenly spread over the sphere; only those with a pitch within
        `pitch_deg` (0 is level, 90 up) count. For `unoccluded` see `views`. Raises ValueError if no direction is left,
        or if the position or a direction is zero or not finite.
        """
        at = np.asarray(position, dtype=np.float64)
        if at.shape != (3,) or not np.isfinite(at).all():
            raise ValueError(f"a position is three finite numbers, not {position!r}")
        along = fibonacci_sphere(directions) if isinstance(directions, int) else np.asarray(directions, np.float64)
        lengths = np.linalg.norm(along, axis=1, keepdims=True)
        if not ((lengths > 0) & np.isfinite(lengths)).all():
            raise ValueError("directions are three finite numbers each, not all zero")
        along = along / lengths
        pitch = np.degrees(np.arcsin(np.clip(along[:, 2], -1, 1)))
        along = along[(pitch >= pitch_deg[0]) & (pitch <= pitch_deg[1])]
        if len(along) == 0:
            raise ValueError(f"no direction has a pitch within {pitch_deg} degrees")
        rotations = rotations_looking_along(along)
        views = self._views_at(self._to_world(at), rotations, unoccluded)
        first = int(np.argmax(views.score))
        rotation = rotations[first] @ self._rotation
        pose = np.concatenate([rotation, -rotation @ at[:, None]], axis=1)
        quaternion = quaternion_xyzw(rotation.T)
        report = {field.name: getattr(views, field.name)[first].item() for field in fields(ScoredViews)}
        return BestView(pose[2, :3], pose, quaternion, **report)

    def _to_world(self, points: Array) -> Array:
        """Transform points (..., 3) of the map to the world."""
        return self._scale * points @ self._rotation.T + self._translation

    def _views_at(self, center: Array, rotations: Array, unoccluded: ArrayLike | None) -> ScoredViews:
        """Score views at one location (3,) m with cam_from_world rotations (D, 3, 3)."""
        candidates, to_place = self._candidates(center, unoccluded)
        with np.errstate(over="ignore"):
            offsets = (self._columns[:, candidates] - center[:, None]).astype(np.float32)  # (3, F) m, in the world
        visible = self._in_image(offsets, rotations)
        n_visible = np.array([len(rows) for rows in visible], dtype=np.int64)
        sampled = [rows if len(rows) <= self._most else rows[np.arange(self._most) * len(rows) // self._most]
                   for rows in visible]  # fmt: skip
        # attributes that do not depend on the direction are computed once per landmark
        used = np.zeros(offsets.shape[1], dtype=bool)
        for rows in sampled:
            used[rows] = True
        values = self._values(offsets[:, used], candidates[used])
        row_of = np.cumsum(used) - 1  # in `values`, of each offset
        score = np.empty(len(rotations))
        inliers = np.empty(len(rotations), dtype=np.float32)
        distance_m = np.full(len(rotations), np.nan)
        across, down, distance = (self._names.index(name) for name in ("across", "down", "distance"))
        for block in self._blocks([len(rows) for rows in sampled]):
            counts = np.array([len(sampled[view]) for view in block], dtype=np.int64)
            padded = np.zeros((len(block), max(1, counts.max()), len(self._names)), dtype=np.float32)
            for own, view in zip(padded, block, strict=True):
                rows = sampled[view]
                own = own[: len(rows)]
                own[:] = values[row_of[rows]]
                x, y, z = rotations[view] @ offsets[:, rows].astype(np.float64)
                own[:, across] = x / z
                own[:, down] = y / z
                if len(rows):
                    distance_m[view] = np.exp(own[:, distance].mean())
            inputs = {"values": padded, "taken": counts, "n_visible": n_visible[block]}
            score[block], inliers[block] = self._session.run(OUTPUTS, inputs)
        in_range = self._serves_camera & self._within("distance_m", distance_m)
        in_range &= (n_visible == 0) | self._within("in_view", n_visible)
        return ScoredViews(score, n_visible, inliers, in_range, np.full(len(rotations), to_place / self._scale))

    def _candidates(self, center: Array, unoccluded: ArrayLike | None) -> tuple[Array, float]:
        """Return rows of the landmarks unoccluded from a location (3,) m, and the distance to the place used."""
        if unoccluded is not None:
            mask = np.asarray(unoccluded, dtype=bool)
            if mask.shape != (len(self.points),):
                raise ValueError(f"unoccluded must be one bool for each landmark, ({len(self.points)},)")
            return np.flatnonzero(mask), np.nan
        if len(self.places) == 0:
            return np.arange(len(self.points)), np.nan
        distance = np.linalg.norm(self.places - center, axis=1)
        nearest = int(np.argmin(distance))
        bits = np.unpackbits(self._unoccluded[nearest], count=len(self.points))
        return np.flatnonzero(bits), float(distance[nearest])

    def _in_image(self, offsets: Array, rotations: Array) -> list[Array]:
        """Return rows of the offsets (3, F) m that are in the image, for each of the rotations (D, 3, 3).

        A point is in the image if 0 <= u < width and 0 <= v < height. Instead of dividing by the depth, it is compared
        with the four planes through the camera centre and the sides of the image. Normals and offsets are in single
        precision and their products in double, as in wheretolook, so that both see the same landmarks.
        """
        c = self.camera
        precise = offsets.astype(np.float64)
        visible = []
        for right, down, forward in rotations:
            sides = np.stack([
                c["fx"] * right + c["cx"] * forward,  # left
                (c["width"] - c["cx"]) * forward - c["fx"] * right,
                c["fy"] * down + c["cy"] * forward,  # top
                (c["height"] - c["cy"]) * forward - c["fy"] * down,
                forward,
            ])  # fmt: skip
            a, b, d, e, depth = sides.astype(np.float32).astype(np.float64) @ precise
            visible.append(np.flatnonzero((a >= 0) & (b > 0) & (d >= 0) & (e > 0) & (depth > 2.0**-10)))
        return visible

    def _values(self, offsets: Array, rows: Array) -> Array:
        """Compute the network's inputs (E, A) of landmarks `rows` (E,) at offsets (3, E) m from the camera.

        In the order of the network's names:

            across, down      x / z and y / z in the camera; 0 here, since they depend on the direction
            distance          logarithm of the distance in metres
            mapped_angle      cosine between the ray from the camera and the mean direction it was mapped from
            distance_ratio    logarithm of the distance over the mean distance it was mapped from
            pixel_angle       logarithm of the angle that a pixel covers: 1 / focal length in pixels
            pixel_size_ratio  logarithm of the size that a pixel covers there, over that when it was mapped
            all others        columns of `attributes` in landmarks.npz
        """
        column = dict(zip(self._map_names, self._attributes[rows].T, strict=True))
        distance = np.sqrt((offsets * offsets).sum(axis=0))
        log_distance = np.log(distance)
        zero = np.zeros_like(distance)
        pixel_angle = np.full_like(distance, -np.log((self.camera["fx"] + self.camera["fy"]) / 2))
        column |= {
            "across": zero,
            "down": zero,
            "distance": log_distance,
            "mapped_angle": (offsets * self._directions[rows].T).sum(axis=0) / distance,
            "distance_ratio": log_distance - column["mapped_distance"],
            "pixel_angle": pixel_angle,
            "pixel_size_ratio": log_distance + pixel_angle - column["mapped_pixel_size"],
        }
        return np.stack([column[name] for name in self._names], axis=1)

    def _blocks(self, counts: Sequence[int]) -> Iterable[Array]:
        """Yield numbers of views with similar counts of landmarks, for little padding, for one call of the network."""
        order = np.argsort(counts, kind="stable")[::-1]
        begin = 0
        while begin < len(order):
            # 32,768 landmarks per call of the network fit into the cache
            end = begin + max(1, (1 << 15) // max(1, int(counts[order[begin]])))
            yield order[begin:end]
            begin = end

    def _within(self, quantity: str, values: Array) -> Array:
        """Test which values (D,) are within the range of the training views; NaN counts as within."""
        low, high = self._range.get(quantity, (-np.inf, np.inf))
        with np.errstate(invalid="ignore"):
            return ~((values < low) | (values > high))


def fibonacci_sphere(n: int) -> Array:
    """Return n unit vectors (n, 3) from +z to -z, almost evenly spread (spherical Fibonacci lattice)."""
    index = np.arange(n)
    z = 1 - (2 * index + 1) / n
    radius = np.sqrt(1 - z * z)
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def rotations_looking_along(directions: ArrayLike) -> Array:
    """Return cam_from_world rotations (D, 3, 3) without roll of cameras that look along directions (D, 3).

    For a camera that looks straight up or down, the image's x axis is the world's.
    """
    forward = np.asarray(directions, dtype=np.float64)
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0], np.zeros(len(forward))], axis=1)
    length = np.linalg.norm(right, axis=1, keepdims=True)
    vertical = length < 1e-9
    right = np.where(vertical, (1.0, 0.0, 0.0), right / np.where(vertical, 1.0, length))
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def quaternion_xyzw(rotation: ArrayLike) -> Array:
    """Return the unit quaternion (4,), w >= 0, of a rotation (3, 3), by Shepperd's method."""
    r = np.asarray(rotation, dtype=np.float64)
    largest = int(np.argmax([r[0, 0], r[1, 1], r[2, 2], np.trace(r)]))
    if largest == 3:
        quaternion = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + np.trace(r)])
    else:
        i = largest
        j = (i + 1) % 3
        k = (i + 2) % 3
        quaternion = np.empty(4)
        quaternion[i] = 1 + r[i, i] - r[j, j] - r[k, k]
        quaternion[j] = r[j, i] + r[i, j]
        quaternion[k] = r[k, i] + r[i, k]
        quaternion[3] = r[k, j] - r[j, k]
    quaternion /= np.linalg.norm(quaternion)
    return quaternion if quaternion[3] >= 0 else -quaternion
