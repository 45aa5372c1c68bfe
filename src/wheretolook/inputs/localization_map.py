"""What a scorer is built from: landmarks, a camera and a model of occlusion."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.colmap_camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float, camera_centers, check_poses
from wheretolook.inputs.bins import BinnedViews, bin_views, count_bins
from wheretolook.mapping.cameras import colmap_poses
from wheretolook.mapping.colmap_model import read_model
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.visibility.frustum import VisibleSets, points_on_device, visible_landmarks, visible_on_device
from wheretolook.visibility.occlusion import NoOcclusion, OcclusionModel

if TYPE_CHECKING:
    from torch import Tensor

SAME_LOCATION_DECIMALS = 6
"""Camera centres that agree to this many decimals of a metre share one visibility test."""


@dataclass(frozen=True, eq=False)
class LocalizationMap:
    """A map to localize against, as seen by everything that scores viewpoints.

    Attributes:
        landmarks: what a camera may recognize.
        camera: the camera that will look: a pinhole, or any COLMAP model.
        occlusion: which landmarks have a free line of sight from a location.
        device: where kernels run, "cpu" or a CUDA device.
        mapping_poses: cam_from_world (M, 3, 4) of the images the map was made from, where they are known.
    """

    landmarks: Landmarks
    camera: Camera = PinholeCamera()
    occlusion: OcclusionModel = NoOcclusion()
    device: str = "cpu"
    mapping_poses: Float | None = None

    @classmethod
    def from_colmap(
        cls,
        model: str | Path,
        camera: Camera = PinholeCamera(),
        mesh: str | Path | None = None,
        occlusion: OcclusionModel | None = None,
        max_reprojection_error_px: float = 0.5,
        device: str = "cpu",
    ) -> LocalizationMap:
        """From any COLMAP model (binary or text) in metres, z up.

        Args:
            model: folder of the model.
            camera: the camera that will look, which need not be the one that mapped; `ColmapCamera.of_map(model)` is
                the latter, with its distortion.
            mesh: a mesh of the scene, for true occlusion.
            occlusion: another model, such as `HiddenPointRemoval()` where there is nothing but the landmarks, or
                `TsdfOcclusion` where there are depth images. With neither, landmarks are seen through walls.
            max_reprojection_error_px: landmarks with a larger mean error are left out.
            device: where kernels run.

        Raises:
            MapError: no usable model in the folder.
            SceneError: the mesh cannot be used.
        """
        reconstruction = read_model(model)
        landmarks = load_colmap_landmarks(
            Path(model), max_reprojection_error_px=max_reprojection_error_px, reconstruction=reconstruction
        )
        occlusion = occlusion or NoOcclusion()
        if mesh is not None:
            from wheretolook.rendering.raycasting import MeshRaycaster
            from wheretolook.scenes.loading import load_mesh
            from wheretolook.space.free_space import FreeSpace
            from wheretolook.visibility.occlusion import MeshOcclusion

            loaded = load_mesh(Path(mesh))
            two_sided = FreeSpace(loaded, device=device).two_sided
            occlusion = MeshOcclusion(MeshRaycaster(loaded, device), two_sided=two_sided)
        return cls(landmarks, camera, occlusion, device, colmap_poses(model, reconstruction).astype(np.float32))

    def bin_views(self, cam_from_world: Float, bins: int = 30, landmark_channels: bool = False) -> BinnedViews:
        """Bin the landmarks that views see. Views that share a location share its occlusion test.

        Args:
            cam_from_world: (B, 3, 4).
            bins: bins along each side of the image.
            landmark_channels: whether the bins also tell what landmarks are like (`ALL_CHANNELS`, not `CHANNELS`).

        Raises:
            ValueError: the poses have another shape, or entries that are not finite.
        """
        cam_from_world = check_poses(cam_from_world)
        unoccluded, rows = self._unoccluded(cam_from_world)
        return bin_views(
            self.camera, cam_from_world, self.landmarks.points, unoccluded, rows, bins=bins, device=self.device,
            landmarks=self.landmarks if landmark_channels else None,
        )  # fmt: skip

    def count_bins(self, cam_from_world: Float, bins: int = 30) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """How many landmarks the views (B, 3, 4) see, and how many bins have one in them, (B,) each.

        Raises:
            ValueError: the poses have another shape, or entries that are not finite.
        """
        cam_from_world = check_poses(cam_from_world)
        unoccluded, rows = self._unoccluded(cam_from_world)
        return count_bins(
            self.camera, cam_from_world, self.landmarks.points, unoccluded, rows, bins=bins, device=self.device
        )

    def visible_landmarks(self, cam_from_world: Float) -> VisibleSets:
        """The landmarks that each of the views (B, 3, 4) sees. Views that share a location share its occlusion test.

        Raises:
            ValueError: the poses have another shape, or entries that are not finite.
        """
        cam_from_world = check_poses(cam_from_world)
        unoccluded, rows = self._unoccluded(cam_from_world)
        return visible_landmarks(self.camera, cam_from_world, self.landmarks.points, unoccluded, rows, self.device)

    def visible_on_device(self, cam_from_world: Float) -> tuple[NDArray[np.int64], Tensor]:
        """What `visible_landmarks` gives, its indices left on the map's device.

        Returns:
            starts: (B + 1,) int64; view b sees the landmarks `indices[starts[b]:starts[b + 1]]`.
            indices: int32, on the map's device.

        Raises:
            ValueError: the poses have another shape, or entries that are not finite.
        """
        import torch  # takes seconds to load
        import warp as wp

        cam_from_world = check_poses(cam_from_world)
        unoccluded, rows = self._unoccluded(cam_from_world)
        if isinstance(self.camera, ColmapCamera):
            visible = visible_landmarks(self.camera, cam_from_world, self.landmarks.points, unoccluded, rows)
            return visible.starts.astype(np.int64), torch.from_numpy(visible.indices).to(self.device)
        starts, indices = visible_on_device(
            self.camera, cam_from_world, self._points_on_device, unoccluded, rows, self.device
        )
        return starts.astype(np.int64), wp.to_torch(indices)

    @cached_property
    def _points_on_device(self) -> Any:
        return points_on_device(self.landmarks.points, self.device)

    def _unoccluded(self, cam_from_world: Float) -> tuple[VisibleSets, NDArray[np.int64]]:
        """Landmarks with a free line of sight from each location of poses, and each pose's row among these."""
        locations, rows = shared_locations(cam_from_world)
        return VisibleSets.from_mask(self.occlusion.unoccluded(locations, self.landmarks.points)), rows


def shared_locations(cam_from_world: Float) -> tuple[Float, NDArray[np.int64]]:
    """Locations (L, 3) m that poses (B, 3, 4) look from, and each pose's row among these, (B,)."""
    centers = np.round(camera_centers(cam_from_world), SAME_LOCATION_DECIMALS)
    if len(centers) == 0:
        return centers, np.empty(0, dtype=np.int64)
    # views of a location mostly follow one another: the first of each run stands for it
    first = np.concatenate([[True], (centers[1:] != centers[:-1]).any(axis=1)])
    if first.sum() == 1:
        return centers[:1], np.zeros(len(centers), dtype=np.int64)
    locations, rows = np.unique(centers[first], axis=0, return_inverse=True)
    return locations, rows.reshape(-1)[np.cumsum(first) - 1]
