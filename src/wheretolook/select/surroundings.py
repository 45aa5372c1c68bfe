"""What a map lies in: what hides landmarks, where a camera can be, and which waypoints make sense."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, PinholeCamera, cameras_by_id
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.select.waypoints import Waypoints
from wheretolook.utils.errors import ConfigError, SceneError, TableError
from wheretolook.utils.images import MAX_DEPTH_PIXELS, read_image
from wheretolook.utils.npz_files import load_npy
from wheretolook.visibility.config import OCCLUSION_NAMES, OcclusionConfig

if TYPE_CHECKING:
    from wheretolook.geometry.tsdf import DepthImage
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.space.mapped_space import MappedSpace
    from wheretolook.visibility.occlusion import OcclusionModel

MOST_LOCATIONS = 1_000_000  # voxels of a grid; more are refused before any work
REACH_SHARE = 0.95  # of the landmarks' mapping distances: so far from all of them nothing is known
ON_LANDMARK_M = 1e-6  # a place this close to a landmark is on a surface
LISTED = 5  # waypoints that an error names


def surroundings(
    mesh: Path | None, depth: Path | None, depth_scale: float, occlusion: str | None, model: Path, device: str
) -> tuple[OcclusionModel, Any]:
    """The occlusion model, and where a camera can be; None for the latter if only the map can tell.

    Of a mesh, of depth images (`read_depth_images`), or of the landmarks alone. Raises a SceneError if mesh or images
    cannot be used, a ConfigError if the name of the occlusion does not fit.
    """
    from wheretolook.visibility.hidden_points import HiddenPointRemoval
    from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion

    config = OcclusionConfig()
    name = occlusion or ("mesh" if mesh else "tsdf" if depth else "hidden-points")
    if name not in OCCLUSION_NAMES:
        raise ConfigError("unknown occlusion", value=name, fix=f"There are {', '.join(OCCLUSION_NAMES)}.")
    if mesh is not None and depth is not None:
        raise ConfigError("occlusion is by a mesh or by depth images", value=str(depth), fix="Give one of them.")
    if (name == "mesh" and mesh is None) or (name == "tsdf" and depth is None):
        given = "a mesh" if name == "mesh" else "depth images"
        raise ConfigError(f"this occlusion needs {given}", value=name, fix="Give them, or use hidden-points or none.")
    space: Any = None
    if mesh is not None:
        from wheretolook.scenes.loading import load_mesh
        from wheretolook.space.free_space import FreeSpace

        space = FreeSpace(load_mesh(mesh), device=device)
        if name == "mesh":
            return MeshOcclusion(space.raycaster, config.margin_m, space.two_sided), space
    if depth is not None:
        from wheretolook.geometry.tsdf import TsdfConfig, TsdfVolume
        from wheretolook.space.tsdf_space import TsdfSpace
        from wheretolook.visibility.tsdf import TsdfOcclusion

        images = read_depth_images(model, depth, depth_scale)
        fused = TsdfVolume.from_images(images, TsdfConfig(config.voxel_m, max_depth_m=config.max_depth_m))
        space = TsdfSpace(fused, images, device=device)
        if name == "tsdf":
            return TsdfOcclusion(fused, config.margin_m, device), space
    return (NoOcclusion() if name == "none" else HiddenPointRemoval(config.radius, config.margin_m)), space


def read_depth_images(model: Path, folder: Path, scale: float = 1000.0) -> list[DepthImage]:
    """Depth images of a COLMAP model's images, from a folder of PNG or TIFF (integers, `scale` a metre; floats, metres)
    or NPY files (metres).

    A depth image has the name of the image it belongs to but for the ending, in which "depth" may stand for "color" or
    "rgb". Its pixels lie on the image's: another size is that of the scaled camera, which must have no distortion.
    Raises a SceneError if there are none or one cannot be read, a ConfigError if the camera has distortion.
    """
    from wheretolook.geometry.tsdf import DepthImage
    from wheretolook.mapping.colmap_model import read_model

    if not folder.is_dir():
        raise SceneError("there is no such folder of depth images", path=folder, fix="Correct the path.")
    if not 0 < scale < np.inf:
        raise ConfigError("the scale of depth images is their unit's number in a metre", value=scale)
    found = read_model(model)
    cameras = cameras_by_id(found.cameras, model)
    files = {p.relative_to(folder).with_suffix("").as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file()}
    images = []
    for number in sorted(found.images):
        image = found.images[number]
        stem = Path(image.name).with_suffix("").as_posix()
        stems = [stem, *(stem.replace(word, "depth") for word in ("color", "colour", "rgb"))]
        path = next((files[name] for name in stems if name in files), None)
        if path is not None and image.has_pose:
            values = _read_depth(path, scale)
            camera = _scaled(cameras[image.camera_id], values.shape[1], values.shape[0], path)
            images.append(DepthImage(values, camera, image.cam_from_world().matrix()))
    if not images:
        fix = f"Name them as the images of the map, such as {Path(found.images[min(found.images)].name).stem}.png."
        raise SceneError("no depth image belongs to an image of the map", path=folder, fix=fix)
    return images


def _read_depth(path: Path, scale: float) -> NDArray[np.float32]:
    if path.suffix.lower() == ".npy":
        try:
            values: NDArray[Any] | None = load_npy(path)
        except ValueError as error:
            raise SceneError(f"cannot read the depth image: {error}", path=path, fix="Export it again.") from error
    else:
        import cv2

        try:
            values = read_image(path, cv2.IMREAD_UNCHANGED, MAX_DEPTH_PIXELS)
        except (OSError, ValueError) as error:
            raise SceneError(f"cannot read the depth image: {error}", path=path, fix="Export it again.") from error
    if values is None or values.ndim != 2 or values.dtype.kind not in "fui":
        shape = None if values is None else values.shape
        raise SceneError("not a depth image of one channel", path=path, value=shape, fix="Export it again.")
    unit = 1.0 if values.dtype.kind == "f" else scale
    depth = (values / unit).astype(np.float32)
    if values.dtype == np.uint16:
        depth[values == np.iinfo(np.uint16).max] = 0  # "no reading" of several cameras
    return depth


def _short(x: float) -> str:
    """A coordinate to three digits, but to the metre at least."""
    return f"{x:.0f}" if abs(x) >= 1000 else f"{x:.3g}"


def _scaled(camera: Camera, width: int, height: int, path: Path) -> PinholeCamera:
    try:
        matrix = camera.matrix
    except ConfigError as error:
        raise ConfigError(error.problem, path=path, value=error.value, fix=error.fix) from error
    across = width / camera.width
    down = height / camera.height
    center = (float(matrix[0, 2] * across), float(matrix[1, 2] * down))
    return PinholeCamera(width, height, float(matrix[0, 0] * across), float(matrix[1, 1] * down), center)


def map_space(localization_map: LocalizationMap) -> MappedSpace:
    """Where a camera can be by the map alone: near the places of its images, clear of landmarks."""
    from wheretolook.space.mapped_space import MappedSpace

    assert localization_map.mapping_poses is not None
    centers = camera_centers(localization_map.mapping_poses.astype(np.float64))
    return MappedSpace(localization_map.landmarks.points, centers)


def grid_waypoints(localization_map: LocalizationMap, space: Any, spacing_m: float) -> Waypoints:
    """Places `spacing_m` apart in all free space; names are their voxels' ids.

    Raises a ConfigError if the spacing is no length or makes too many, a SceneError if none is free.
    """
    if not 0 < spacing_m < np.inf:
        raise ConfigError("the spacing of a grid is a length in metres", value=spacing_m, fix="Such as 0.5.")
    low, high = np.asarray(space.bounds, dtype=np.float64)
    cells = np.maximum(np.ceil((high - low) / spacing_m), 1)
    if np.prod(cells) > MOST_LOCATIONS:
        fix = f"The map is {high[0] - low[0]:.3g} x {high[1] - low[1]:.3g} x {high[2] - low[2]:.3g} m; widen the grid."
        raise ConfigError(f"the grid has more than {MOST_LOCATIONS:,} places", value=spacing_m, fix=fix)
    nx, ny, nz = (int(n) for n in cells)
    middle = (low + high) / 2
    half = cells * spacing_m / 2
    grid = VoxelGrid.over(np.stack([middle - half, middle + half]), (nx, ny, nz))
    centers = grid.centers()
    free = np.flatnonzero(space.is_free(centers))
    free = free[~localization_map.occlusion.inside_geometry(centers[free])]
    if len(free) == 0:
        raise SceneError("no place of the grid is free", value=spacing_m, fix="Narrow the grid.")
    return Waypoints(centers[free], tuple(map(str, free)))


def usable_waypoints(localization_map: LocalizationMap, waypoints: Waypoints, skip: bool = False) -> NDArray[np.bool_]:
    """At which waypoints views can be judged, (W,): at all of them, unless others are to be left out.

    Outside the map is what is farther from every landmark, and from every mapping camera, than all but 5 % of the
    landmarks were from the cameras that mapped them. Raises a TableError that names the first of those outside the map
    or inside geometry, or if none is left.
    """
    from scipy.spatial import cKDTree

    landmarks = localization_map.landmarks
    reach = float(np.quantile(landmarks.mapping_distance_m, REACH_SHARE))
    to_landmark = cKDTree(landmarks.points).query(waypoints.points)[0]
    nearest: Float = to_landmark
    if localization_map.mapping_poses is not None:
        centers = camera_centers(localization_map.mapping_poses.astype(np.float64))
        nearest = np.minimum(nearest, cKDTree(centers).query(waypoints.points)[0])
    outside = nearest > reach
    inside = ~outside & (to_landmark <= ON_LANDMARK_M)
    rest = np.flatnonzero(~outside & ~inside)
    inside[rest] = localization_map.occlusion.inside_geometry(waypoints.points[rest])
    bad = outside | inside
    if not bad.any() or (skip and not bad.all()):
        return np.asarray(~bad)
    told = []
    for row in np.flatnonzero(bad)[:LISTED]:
        why = f"{nearest[row]:.3g} m from all landmarks and cameras" if outside[row] else "inside geometry"
        told.append(f"{waypoints.where(row)} {why}")
    more = f", and {bad.sum() - LISTED} more" if bad.sum() > LISTED else ""
    problem = f"{bad.sum()} of {len(waypoints)} waypoints lie outside the map or inside geometry"
    low, high = np.quantile(landmarks.points, (0.01, 0.99), axis=0)
    box = " to ".join("(" + ", ".join(_short(x) for x in corner) + ")" for corner in (low, high))
    fix = f"The map's landmarks lie within {box}, in its unit: check unit and axes"
    fix += "." if bad.all() else ", or leave these out: --skip, in Python skip=True."
    raise TableError(problem, path=waypoints.path, value="; ".join(told) + more, fix=fix)
