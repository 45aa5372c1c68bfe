"""The surface in views of a place, and which images would make landmarks on it that these views can match."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float, camera_centers, transform, unit
from wheretolook.inputs.localization_map import LocalizationMap, shared_locations
from wheretolook.space.free_space import FreeSpace, TsdfSpace
from wheretolook.visibility.frustum import pixels_of


@dataclass(frozen=True, eq=False)
class Patches:
    """P patches of surface, each as one of V views sees it: at most one in each cell of a grid over the image."""

    n_views: int
    n_cells: int
    view: NDArray[np.int64]  # (P,) row of the view
    points: Float  # (P, 3) m in the world
    axes: Float  # (P, 3) unit direction from the view
    distance_m: Float  # (P,) from the view
    landmark: NDArray[np.int64]  # (P,) row in the map; -1 for other surface

    def shares(self, chosen: NDArray[np.bool_]) -> Float:
        """Return the share of the cells of each view's image whose patch is among those chosen (P,), (V,)."""
        return np.bincount(self.view, chosen, self.n_views) / self.n_cells


class Surface:
    """The surface of a place: a mesh's, that which depth images fuse to, or without these the landmarks themselves.

    `space` is where a camera can be, a `FreeSpace` or a `MappedSpace`. `name` is "mesh", "depth images" or "landmarks".
    """

    def __init__(self, localization_map: LocalizationMap, space: Any) -> None:
        self.localization_map = localization_map
        self.space = space
        self.raycaster = space.raycaster if isinstance(space, FreeSpace) else None
        by_rays = "depth images" if isinstance(space, TsdfSpace) else "mesh"
        self.name = "landmarks" if self.raycaster is None else by_rays

    def patches(self, cam_from_world: Float, across: int, down: int) -> Patches:
        """Return the surface in the cells, so many across and down the image, of views (V, 3, 4) of the map's camera.

        It is where a ray through the middle of a cell meets the mesh, or without either the landmark of the longest track
        in the cell. Where depth images or landmarks show none, it is assumed at the median distance of landmarks.
        """
        camera = self.localization_map.camera
        centers = camera_centers(cam_from_world)
        x, y = np.meshgrid((np.arange(across) + 0.5) / across, (np.arange(down) + 0.5) / down)
        rays = camera.unproject(np.column_stack([x.ravel() * camera.width, y.ravel() * camera.height]))
        cells = np.flatnonzero(np.isfinite(rays).all(axis=1))
        axes = (rays[cells] @ cam_from_world[:, :, :3]).reshape(-1, 3)
        view = np.repeat(np.arange(len(centers)), len(cells))
        landmark = np.full(len(view), -1)
        landmarks = self.localization_map.landmarks
        distance = np.full(len(view), np.inf)
        if self.raycaster is not None:
            distance = self.raycaster.cast(centers[view], axes).distance_m
        if self.name == "mesh":
            hit = np.isfinite(distance)
            view, landmark, axes, distance = view[hit], landmark[hit], axes[hit], distance[hit]
        distance = np.where(np.isfinite(distance), distance, np.median(landmarks.mapping_distance_m))
        points = centers[view] + axes * distance[:, None]
        if self.raycaster is None:
            landmark = self._landmark_of_cells(cam_from_world, across, down)[:, cells].ravel()
            points[landmark >= 0] = landmarks.points[landmark[landmark >= 0]]
        lines = points - centers[view]
        return Patches(len(centers), across * down, view, points, unit(lines), np.linalg.norm(lines, axis=1), landmark)

    def _landmark_of_cells(self, cam_from_world: Float, across: int, down: int) -> NDArray[np.int64]:
        """Return the landmark (V, cells) in each cell of images; -1 for none."""
        camera = self.localization_map.camera
        landmarks = self.localization_map.landmarks
        found = np.full((len(cam_from_world), across * down), -1)
        sets = self.localization_map.landmarks_in_view(cam_from_world)
        for view in range(len(sets)):
            visible = sets[view]
            visible = visible[np.argsort(landmarks.track_length[visible], kind="stable")]  # the longest is written last
            share = pixels_of(camera, transform(cam_from_world[view], landmarks.points[visible]))
            share /= (camera.width, camera.height)
            column, row = np.clip((share * (across, down)).astype(np.int64), 0, (across - 1, down - 1)).T
            found[view, row * across + column] = visible
        return found

    def covering(self, patches: Patches, cam_from_world: Float, cameras: Sequence[Camera]) -> csr_array:
        """Return which images (I, 3, 4) of cameras (I,) show which patches so that a landmark there would be matched.

        They see a patch within 35 degrees of its view and a factor of 2.2 in the size of its image, a sparse matrix
        (I, P) of ones.
        """
        locations, location_of = shared_locations(cam_from_world)
        own_px = self.localization_map.camera.colmap.mean_focal_px
        sizes = own_px / np.array([camera.colmap.mean_focal_px for camera in cameras])
        found: list[NDArray[np.int64]] = []
        block = 64  # locations whose lines of sight to all landmarks are held at a time
        for at in range(len(locations)):
            if self.raycaster is None and at % block == 0:
                points = self.localization_map.landmarks.points
                unoccluded = self.localization_map.occlusion.unoccluded(locations[at : at + block], points)
            lines = patches.points - locations[at]
            distance = np.linalg.norm(lines, axis=1)
            cosine = np.einsum("pi,pi->p", lines, patches.axes)
            rows = np.flatnonzero(cosine >= np.cos(np.radians(35)) * distance)
            images = np.flatnonzero(location_of == at)
            scale = distance / patches.distance_m
            rows = rows[(scale[rows] * sizes[images].min() < 2.2) & (scale[rows] * sizes[images].max() > 1 / 2.2)]
            if self.raycaster is not None:
                hit_m = self.raycaster.cast(locations[at], lines[rows]).distance_m
                rows = rows[hit_m >= distance[rows] - 0.05]
            else:
                rows = rows[unoccluded[at % block, patches.landmark[rows]] | (patches.landmark[rows] < 0)]
            for image in images.tolist():
                size = scale[rows] * sizes[image]
                alike = rows[(size < 2.2) & (size > 1 / 2.2)]
                seen = alike[_sees(cameras[image], transform(cam_from_world[image], patches.points[alike]))]
                found.append(np.stack([np.full(len(seen), image), seen]))
        image, patch = np.concatenate(found, axis=1) if found else np.empty((2, 0), dtype=np.int64)
        shape = (len(cam_from_world), len(patches.view))
        return csr_array((np.ones(len(image), dtype=np.float32), (image, patch)), shape=shape)


def _sees(camera: Camera, in_camera: Float) -> NDArray[np.bool_]:
    """Return whether a camera sees points (N, 3) in its frame."""
    if isinstance(camera, PinholeCamera):
        return camera.in_image(camera.project(in_camera)) & (in_camera[:, 2] > 0)
    return camera.sees(in_camera)


def mapping_views(localization_map: LocalizationMap) -> tuple[Float, list[Camera]]:
    """Return poses (M, 3, 4) and cameras of the mapping images; the map's camera for all where theirs are unknown."""
    known = localization_map.map
    if known.images is not None and known.cameras:
        cameras = [known.cameras[number] for number in known.images.image_cameras.tolist()]
        return known.images.image_poses, cameras
    poses = np.empty((0, 3, 4)) if known.mapping_poses is None else known.mapping_poses.astype(np.float64)
    return poses, [localization_map.camera] * len(poses)
