"""The map that a scorer is built from: landmarks, a camera and a model of occlusion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float, camera_centers, check_poses
from wheretolook.inputs.bins import BinnedViews, bin_views, count_bins
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.mapping.map_frame import MapFrame, warn_of_mesh
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import check_positive
from wheretolook.visibility import frustum
from wheretolook.visibility.frustum import LandmarkSets, PosedViews, in_view_by_table, landmarks_in_view
from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion, OcclusionModel

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, eq=False)
class LocalizationMap:
    """A map to localize against, for everything that scores viewpoints."""

    map: Map  # in the world: metres, z up
    camera: Camera  # the one to localize: a pinhole, or any COLMAP model
    occlusion: OcclusionModel = NoOcclusion()  # which landmarks have a free line of sight from a location
    device: str = "cpu"  # where kernels run, "cpu" or a CUDA device

    @classmethod
    def from_colmap(
        cls,
        model: str | Path,
        camera: Camera | int | None = None,
        mesh: str | Path | None = None,
        mesh_up: str = "z",
        occlusion: OcclusionModel | None = None,
        max_reprojection_error_px: float | None = None,
        device: str = "cpu",
        database: str | Path | None = None,
        **frame: Any,
    ) -> LocalizationMap:
        """Open any COLMAP model, as `wheretolook.mapping.map.Map.open`, whose arguments, warnings and errors are these.

        Poses that scorers of it take are in the world, metres with z up: `frame.world_from_map` transforms them. A
        `MapWarning` also states that the mesh seems to be in another frame.

        Args:
            model: folder of the model.
            camera: the camera to localize, which may differ from the mapping cameras: a camera, or the camera_id of one
                of the model. None for the model's own, with its distortion, if it has but one.
            mesh: a mesh of the scene in the model's frame, for true occlusion.
            mesh_up: which axis of the mesh's file is the model's z: "x", "y" or "z", with "-" if it points down.
            occlusion: another model, such as `HiddenPointRemoval()` where there is nothing but the landmarks, or
                `TsdfOcclusion` where there are depth images. With neither, landmarks are seen through walls.
            max_reprojection_error_px: landmarks with a larger mean error are left out.
            device: where kernels run.
            database: features, for the landmarks' ambiguity.
            frame: scale, distance, positions or up, see `wheretolook.mapping.config.FrameOptions`.

        Raises:
            MapError: as `Map.open`; or no such camera in the model, or several and none is named.
            SceneError: the mesh cannot be used.
            ConfigError: the largest reprojection error is not positive.
        """
        if max_reprojection_error_px is not None:
            check_positive("max_reprojection_error_px", max_reprojection_error_px)
        opened = Map.open(model, database, FrameOptions(**frame), max_reprojection_error_px, device)
        camera = opened.camera(camera)
        if mesh is not None:
            from wheretolook.scenes.loading import load_mesh

            to_world = opened.frame.world_from_map
            space = FreeSpace(load_mesh(Path(mesh), mesh_up, colored=False).transformed(to_world), device=device)
            occlusion = MeshOcclusion(space.raycaster, two_sided=space.two_sided)
            warn_of_mesh(mesh, opened.landmarks.points, space.raycaster)
        return cls(opened, camera, occlusion or NoOcclusion(), device)

    @property
    def landmarks(self) -> Landmarks:
        """The map's landmarks."""
        return self.map.landmarks

    @property
    def frame(self) -> MapFrame:
        """The map's own frame; everything here is in the world."""
        return self.map.frame

    @property
    def mapping_poses(self) -> Float | None:
        """Poses cam_from_world (M, 3, 4) of the mapping images; None if unknown."""
        return self.map.mapping_poses

    def of_camera(self, camera: Camera) -> LocalizationMap:
        """Return the same map for another camera."""
        return self if camera == self.camera else replace(self, camera=camera)

    def bin_views(self, cam_from_world: Float, bins: int = 30, landmark_channels: bool = False) -> BinnedViews:
        """Bin the visible landmarks of views (B, 3, 4) in bins x bins cells of the image.

        Bins have `CHANNELS`, or with `landmark_channels` also the landmarks' attributes, `ALL_CHANNELS`. Here as in
        the other methods, views at the same location share its occlusion test, and poses of another shape or with
        entries that are not finite raise ValueError.
        """
        described = self.landmarks if landmark_channels else None
        return bin_views(self._views(cam_from_world), bins, self.device, described)

    def count_bins(self, cam_from_world: Float, bins: int = 30) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the visible landmarks of views (B, 3, 4), and the bins that have at least one, (B,) each."""
        return count_bins(self._views(cam_from_world), bins, self.device)

    def landmarks_in_view(self, cam_from_world: Float) -> LandmarkSets:
        """Return the visible landmarks of each of the views (B, 3, 4)."""
        return landmarks_in_view(self._views(cam_from_world), self.device)

    def in_view_on_device(self, cam_from_world: Float) -> tuple[NDArray[np.int64], Tensor]:
        """Return the visible landmarks of views (B, 3, 4) as starts (B + 1,) and indices int32 on the map's device."""
        import torch  # takes seconds to load

        views = self._views(cam_from_world)
        if not isinstance(self.camera, ColmapCamera):
            starts, indices = frustum.in_view_on_device(views, self._points_on_device, self.device)
            return starts.astype(np.int64), wp.to_torch(indices)
        # lines of sight: tabulating the field of view takes about a second
        if int(np.diff(views.unoccluded.starts)[views.location_rows].sum()) >= 1_000_000:
            sets = in_view_by_table(views, self._points_on_device, self.device)
        else:
            sets = landmarks_in_view(views)
        return sets.starts.astype(np.int64), torch.from_numpy(sets.indices).to(self.device)

    @property
    def _points_on_device(self) -> Any:
        known = self.map.computed
        if self.device not in known:
            known[self.device] = frustum.points_on_device(self.landmarks.points, self.device)
        return known[self.device]

    def _views(self, cam_from_world: Float) -> PosedViews:
        poses = check_poses(cam_from_world)
        points = self.landmarks.points
        locations, rows = shared_locations(poses)
        unoccluded = LandmarkSets.from_mask(self.occlusion.unoccluded(locations, points))
        return PosedViews(self.camera, poses, points, unoccluded, rows)


def shared_locations(cam_from_world: Float) -> tuple[Float, NDArray[np.int64]]:
    """Return the distinct locations (L, 3) m of poses (B, 3, 4), and each pose's row among these, (B,)."""
    # centres that agree to a micrometre share one visibility test
    centers = np.round(camera_centers(cam_from_world), 6)
    # views at a location mostly follow one another: compare the first of each run only
    first = np.ones(len(centers), dtype=bool)
    first[1:] = (centers[1:] != centers[:-1]).any(axis=1)
    if first.sum() == 1:
        return centers[:1], np.zeros(len(centers), dtype=np.int64)
    locations, rows = np.unique(centers[first], axis=0, return_inverse=True)
    return locations, rows.reshape(-1)[np.cumsum(first) - 1]
