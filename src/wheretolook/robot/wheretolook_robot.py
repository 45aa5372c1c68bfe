"""Where to point a camera so that it knows where it is: the scorer of wheretolook on a robot.

This one file needs NumPy and onnxruntime, nothing else of wheretolook and no PyTorch. It lies in the folder that
`wheretolook export --map SPARSE --out FOLDER` writes, and reads the other files there:

    scorer.onnx     the network: from the landmarks that a view sees to the probability that the view localizes
    landmarks.npz   the map, N landmarks, all plain arrays:
        points      (N, 3) float64, metres in the world
        directions  (N, 3) float32, unit mean direction from the mapping cameras to the landmark, in the world
        attributes  (N, M) float32, what the map knows of each landmark; NaN where it does not know
        places      (L, 3) float64, where it was computed which landmarks can be seen; L = 0 if nowhere
        unoccluded  (L, ceil(N / 8)) uint8, bits as `numpy.packbits` packs them: 1 where nothing stands between
    robot.json      the camera, the names of the attributes, and the range of views that the network has learnt from

In Python, from that folder:

    from wheretolook_robot import RobotScorer

    scorer = RobotScorer("FOLDER")
    view = scorer.best((1.0, 2.0, 1.5))     # of 500 directions at this place
    view.direction, view.score              # where to look, and how probably it localizes
    scorer.score(cam_from_world)            # (B,) of any poses (B, 3, 4)

Frames and units. The world is the map's: metres, z up. A camera looks along its z, x is right and y down in the image
(OpenCV, COLMAP, the optical frame of ROS). A pose is the matrix `cam_from_world` = [R | t], (3, 4): a point p of the
world lies at R p + t in the camera, whose centre is -R^T t. Pixel (0.5, 0.5) is the centre of the top-left pixel.
Focal lengths are in pixels, angles in degrees where a name says so, and quaternions are xyzw as in ROS.

The camera is a pinhole: of a lens with distortion, that of its rectified images.

Occlusion is not computed here: nothing is known of walls but what the export stored. With `places`, a view takes the
landmarks that can be seen from the nearest of them (`Views.place_m` tells how far that is). Without, landmarks are seen
through walls, and scores are too high where there are any. A robot that knows better gives `unoccluded`, (N,) bool.

What is computed, in the order of this file: which landmarks lie in the image; what is known of each of them from here;
and the network, which onnxruntime runs. Scores are those of wheretolook's PyTorch scorer to within 1e-5.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

FORMAT_VERSION = 1  # of the folder
MIN_DEPTH_M = 2.0**-10  # nothing nearer to the image plane than this is seen, or behind it
BLOCK = 1 << 15  # landmarks that the network looks at in one call: they fit into the cache

Array = NDArray[Any]


@dataclass(frozen=True)
class Views:
    """What is known of B views."""

    score: Array  # (B,) float64, the probability that the view localizes
    n_visible: Array  # (B,) int64, landmarks in view
    expected_inliers: Array  # (B,) float32, of these how many can be expected to be matched, and right
    in_range: Array  # (B,) bool, whether the view is like those that the network has learnt from
    place_m: Array  # (B,) float64, metres to the place whose occlusion was taken; NaN if none was


@dataclass(frozen=True)
class BestView:
    """The best view at a place, and what is known of it as of `Views`."""

    direction: Array  # (3,) unit vector in the world along which the camera looks
    cam_from_world: Array  # (3, 4) pose; the image's x axis is level
    quaternion_xyzw: Array  # (4,) orientation of the camera (optical frame) in the world, as ROS wants it
    score: float
    n_visible: int
    expected_inliers: float
    in_range: bool
    place_m: float


class RobotScorer:
    """Scores views of a map, as `wheretolook export` wrote both into a folder.

    Args:
        folder: with scorer.onnx, landmarks.npz and robot.json.
        threads: cores that the network may use.

    Raises:
        OSError: a file is missing.
        ValueError: the folder is of another version, or its files do not belong together.
    """

    def __init__(self, folder: str | Path, threads: int = 1) -> None:
        folder = Path(folder)
        about = json.loads((folder / "robot.json").read_text(encoding="utf-8"))
        if about.get("format_version") != FORMAT_VERSION:
            raise ValueError(f"{folder / 'robot.json'}: this file reads format {FORMAT_VERSION}. Export again.")
        self.camera: dict[str, float] = about["camera"]  # width, height, fx, fy, cx, cy in pixels
        self._names: list[str] = about["attributes"]  # that the network looks at, in its order
        self._map_names: list[str] = about["map_attributes"]  # columns of `attributes` in landmarks.npz
        self._most = int(about["most"])  # landmarks that are looked at in a view; of more, evenly spread ones
        self._range: dict[str, list[float]] = about["range"]
        self._serves_camera = bool(about["serves_camera"])
        with np.load(folder / "landmarks.npz") as stored:
            self.points: Array = stored["points"]
            self._directions = stored["directions"]
            self._attributes = stored["attributes"]
            self.places: Array = stored["places"]
            self._unoccluded = stored["unoccluded"]
        self._columns = np.ascontiguousarray(self.points.T)  # (3, N): whole rows of x, y and z are faster
        if len(self.points) != about["n_landmarks"]:
            raise ValueError(f"{folder / 'landmarks.npz'}: not the landmarks that robot.json tells of. Export again.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads leave the core alone
        path = str(folder / "scorer.onnx")
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path}: there is no network. Export again.")
        self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def score(self, cam_from_world: ArrayLike, unoccluded: ArrayLike | None = None) -> Array:
        """Probabilities (B,) that poses (B, 3, 4) localize; see `views`."""
        return self.views(cam_from_world, unoccluded).score

    def views(self, cam_from_world: ArrayLike, unoccluded: ArrayLike | None = None) -> Views:
        """What is known of poses (B, 3, 4), or of one (3, 4).

        `unoccluded` (N,) bool tells which landmarks nothing hides from these poses; without it the nearest of `places`
        does, if there are any. Raises ValueError on other shapes, or a pose that is not finite.
        """
        poses = np.asarray(cam_from_world, dtype=np.float64)
        poses = poses[None] if poses.ndim == 2 else poses
        if poses.shape[1:] != (3, 4) or not np.isfinite(poses).all():
            raise ValueError(f"cam_from_world must be finite, (B, 3, 4), not {poses.shape}")
        rotations = poses[:, :, :3]
        centers = -np.einsum("bji,bj->bi", rotations, poses[:, :, 3])
        # views at one place, one after the other, share what depends on the place
        moved = (np.abs(np.diff(centers, axis=0)) > 1e-8).any(axis=1)
        firsts = [0, *(np.flatnonzero(moved) + 1).tolist(), len(poses)] if len(poses) else []
        parts = [self._views_at(centers[a], rotations[a:b], unoccluded) for a, b in pairwise(firsts)]
        return _joined(parts)

    def best(
        self,
        position: ArrayLike,
        directions: int | ArrayLike = 500,
        unoccluded: ArrayLike | None = None,
        pitch_deg: tuple[float, float] = (-90.0, 90.0),
    ) -> BestView:
        """The view with the highest score at a position (3,) m.

        `directions` to look along are (D, 3), or so many spread evenly over the sphere; only those whose pitch, up from
        level, is within `pitch_deg` count. For `unoccluded` see `views`. Raises ValueError if no direction is left, one
        has no length, or one or the position is not finite.
        """
        at = np.asarray(position, dtype=np.float64)
        if at.shape != (3,) or not np.isfinite(at).all():
            raise ValueError(f"a position is three finite numbers in metres, not {position!r}")
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
        views = self._views_at(at, rotations, unoccluded)
        first = int(np.argmax(views.score))
        pose = np.concatenate([rotations[first], -rotations[first] @ at[:, None]], axis=1)
        quaternion = quaternion_xyzw(rotations[first].T)
        found = views.score[first], views.n_visible[first], views.expected_inliers[first]
        rest = bool(views.in_range[first]), float(views.place_m[first])
        return BestView(along[first], pose, quaternion, float(found[0]), int(found[1]), float(found[2]), *rest)

    def _views_at(self, center: Array, rotations: Array, unoccluded: ArrayLike | None) -> Views:
        """What is known of views from one place (3,) m with cam_from_world rotations (D, 3, 3)."""
        free, place_m = self._free_from(center, unoccluded)
        with np.errstate(over="ignore"):
            from_center = self._columns if free is None else self._columns[:, free]
            offsets = (from_center - center[:, None]).astype(np.float32)  # (3, F) m, in the world
        seen = self._in_image(offsets, rotations)
        n_visible = np.array([len(rows) for rows in seen], dtype=np.int64)
        # of very many landmarks so many evenly spread ones stand for all
        most = self._most
        looked_at = [rows if len(rows) <= most else rows[np.arange(most) * len(rows) // most] for rows in seen]
        # what does not depend on the direction is computed once for each landmark that any view looks at
        described = looked_at[0] if len(looked_at) == 1 else _union(looked_at, offsets.shape[1])
        number = np.empty(offsets.shape[1], dtype=np.int64)  # of each offset, its row in `values`
        number[described] = np.arange(len(described))
        values = self._values(offsets[:, described], described if free is None else free[described])
        score = np.empty(len(rotations))
        inliers = np.empty(len(rotations), dtype=np.float32)
        distance_m = np.full(len(rotations), np.nan)
        for block in self._blocks(looked_at):
            taken = np.array([len(looked_at[view]) for view in block], dtype=np.int64)
            padded = np.zeros((len(block), max(1, taken.max()), len(self._names)), dtype=np.float32)
            for k, view in enumerate(block):
                rows = looked_at[view]
                own = padded[k, : len(rows)]
                own[:] = values[number[rows]]
                x, y, z = rotations[view] @ offsets[:, rows].astype(np.float64)
                own[:, self._names.index("across")] = x / z
                own[:, self._names.index("down")] = y / z
                if len(rows):
                    distance_m[view] = np.exp(own[:, self._names.index("distance")].mean())
            given = {"values": padded, "taken": taken, "n_visible": n_visible[block]}
            given["axis_height"] = rotations[block, 2, 2].astype(np.float32)
            score[block], inliers[block] = self._session.run(["probability", "expected_inliers"], given)
        in_range = self._serves_camera & self._within("distance_m", distance_m)
        in_range &= (n_visible == 0) | self._within("in_view", n_visible)
        return Views(score, n_visible, inliers, in_range, np.full(len(rotations), place_m))

    def _free_from(self, center: Array, unoccluded: ArrayLike | None) -> tuple[Array | None, float]:
        """Rows of the landmarks that nothing hides from a place (3,) m, None for all, and how far off that is known."""
        if unoccluded is not None:
            mask = np.asarray(unoccluded, dtype=bool)
            if mask.shape != (len(self.points),):
                raise ValueError(f"unoccluded must be one bool for each landmark, ({len(self.points)},)")
            return np.flatnonzero(mask), np.nan
        if len(self.places) == 0:
            return None, np.nan
        distance = np.linalg.norm(self.places - center, axis=1)
        nearest = int(np.argmin(distance))
        bits = np.unpackbits(self._unoccluded[nearest], count=len(self.points))
        return np.flatnonzero(bits), float(distance[nearest])

    def _in_image(self, offsets: Array, rotations: Array) -> list[Array]:
        """Rows of the offsets (3, F) m from the camera that lie in the image, for each of the rotations (D, 3, 3).

        A point is in the image if its pixel is: 0 <= u < width and 0 <= v < height. Instead of dividing by its depth,
        it is compared with the four planes through the camera's centre and the image's sides. Normals and offsets are
        in single precision and their products in double, as in wheretolook, so that both see the same landmarks.
        """
        c = self.camera
        precise = offsets.astype(np.float64)
        seen = []
        for right, down, forward in rotations:
            sides = np.stack([
                c["fx"] * right + c["cx"] * forward,  # left
                (c["width"] - c["cx"]) * forward - c["fx"] * right,
                c["fy"] * down + c["cy"] * forward,  # top
                (c["height"] - c["cy"]) * forward - c["fy"] * down,
                forward,
            ])  # fmt: skip
            a, b, d, e, depth = sides.astype(np.float32).astype(np.float64) @ precise
            seen.append(np.flatnonzero((a >= 0) & (b > 0) & (d >= 0) & (e > 0) & (depth > MIN_DEPTH_M)))
        return seen

    def _values(self, offsets: Array, rows: Array) -> Array:
        """What the network looks at of landmarks `rows` (E,) of the map at offsets (3, E) m from the camera; (E, A).

        In the order of the network's names. What the camera's direction decides is 0 here and follows later:

            across, down      x / z and y / z in the camera
            distance          logarithm of the distance in metres
            mapped_angle      cosine between the ray from the camera and the mean direction it was mapped from
            distance_ratio    logarithm of the distance over the mean distance it was mapped from
            pixel_angle       logarithm of the angle that a pixel covers: 1 / focal length in pixels
            pixel_size_ratio  logarithm of the size that a pixel covers there, over that when it was mapped
            all others        columns of `attributes` in landmarks.npz, as they are
        """
        known = self._attributes[rows]
        mapped_along = self._directions[rows].T
        column = {name: known[:, place] for place, name in enumerate(self._map_names)}
        distance = np.sqrt((offsets * offsets).sum(axis=0))
        log_distance = np.log(distance)
        zero = np.zeros_like(distance)
        pixel_angle = np.full_like(distance, -np.log((self.camera["fx"] + self.camera["fy"]) / 2))
        column |= {
            "across": zero,
            "down": zero,
            "distance": log_distance,
            "mapped_angle": (offsets * mapped_along).sum(axis=0) / distance,
            "distance_ratio": log_distance - column["mapped_distance"],
            "pixel_angle": pixel_angle,
            "pixel_size_ratio": log_distance + pixel_angle - column["mapped_pixel_size"],
        }
        return np.stack([column[name] for name in self._names], axis=1)

    def _blocks(self, looked_at: Sequence[Array]) -> Iterable[Array]:
        """Numbers of the views that the network is given together: like many landmarks, so that few are padded."""
        counts = np.array([len(rows) for rows in looked_at])
        order = np.argsort(counts, kind="stable")[::-1]
        begin = 0
        while begin < len(order):
            end = begin + max(1, BLOCK // max(1, int(counts[order[begin]])))
            yield order[begin:end]
            begin = end

    def _within(self, quantity: str, values: Array) -> Array:
        """Which values (D,) the network has learnt from; what is not known is not outside."""
        low, high = self._range.get(quantity, (-np.inf, np.inf))
        with np.errstate(invalid="ignore"):
            return ~((values < low) | (values > high))


def _union(sets: Sequence[Array], n: int) -> Array:
    """Numbers below n that are in any of the sets, in order."""
    used = np.zeros(n, dtype=bool)
    for numbers in sets:
        used[numbers] = True
    return np.flatnonzero(used)


def _joined(parts: Sequence[Views]) -> Views:
    if not parts:
        none = np.empty(0)
        return Views(none, none.astype(np.int64), none.astype(np.float32), none.astype(bool), none)
    names = ("score", "n_visible", "expected_inliers", "in_range", "place_m")
    return Views(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def fibonacci_sphere(n: int) -> Array:
    """n unit vectors (n, 3) from +z to -z, spread almost evenly over the sphere (spherical Fibonacci lattice)."""
    index = np.arange(n)
    z = 1 - (2 * index + 1) / n
    radius = np.sqrt(1 - z * z)
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)


def rotations_looking_along(directions: ArrayLike) -> Array:
    """cam_from_world rotations (D, 3, 3) of cameras that look along (D, 3) and do not roll.

    The image's x axis is level and its y axis points down as far as it can. Of a camera that looks straight up or down,
    the image's x axis is the world's.
    """
    forward = np.asarray(directions, dtype=np.float64)
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.stack([forward[:, 1], -forward[:, 0], np.zeros(len(forward))], axis=1)
    length = np.linalg.norm(right, axis=1, keepdims=True)
    vertical = length < 1e-9
    right = np.where(vertical, (1.0, 0.0, 0.0), right / np.where(vertical, 1.0, length))
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def cam_from_world_of(position: ArrayLike, orientation_xyzw: ArrayLike) -> Array:
    """The pose (3, 4) of a camera at a position (3,) m with an orientation (4,) in the world, as ROS tells it.

    The orientation is that of the optical frame: it turns the camera's axes into the world's. The quaternion need not
    be of unit length.
    """
    quaternion = np.asarray(orientation_xyzw, dtype=np.float64)
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    world_from_cam = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    rotation = world_from_cam.T
    return np.concatenate([rotation, -rotation @ np.asarray(position, dtype=np.float64)[:, None]], axis=1)


def quaternion_xyzw(rotation: ArrayLike) -> Array:
    """The unit quaternion (4,), w >= 0, of a rotation (3, 3), by Shepperd's method."""
    r = np.asarray(rotation, dtype=np.float64)
    squares = np.array([r[0, 0], r[1, 1], r[2, 2], np.trace(r)])
    largest = int(np.argmax(squares))
    if largest == 3:
        found = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], 1 + squares[3]])
    else:
        i = largest
        j = (largest + 1) % 3
        k = (largest + 2) % 3
        found = np.empty(4)
        found[i] = 1 + r[i, i] - r[j, j] - r[k, k]
        found[3] = r[k, j] - r[j, k]
        found[j] = r[j, i] + r[i, j]
        found[k] = r[k, i] + r[i, k]
    found /= np.linalg.norm(found)
    return found if found[3] >= 0 else -found
