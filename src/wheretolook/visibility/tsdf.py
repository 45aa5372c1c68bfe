"""Occlusion from depth images alone: lines of sight are rays against the surface fused from them.

Its triangles are extracted once. Casting rays through the voxels instead, as six depth images around each location
(`VoxelBlockGrid.ray_cast`), took 20 to 30 times as long on a CPU and missed thin things.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.geometry.tsdf import TsdfVolume
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.visibility.occlusion import MeshOcclusion, OcclusionInputs


class TsdfOcclusion(MeshOcclusion):
    """Occlusion by the surface of a TSDF: one ray for each location and landmark.

    Space that no depth image saw occludes nothing. The volume is no longer needed afterwards. A surface up to
    `margin_m` in front of a landmark is the landmark's own; keep the margin above two voxels. Raises ConfigError if it
    is negative, or there is no such device; SceneError if the depth images show no surface.
    """

    name = "tsdf"

    def __init__(self, volume: TsdfVolume, margin_m: float = 0.05, device: str = "cpu") -> None:
        super().__init__(MeshRaycaster(volume.surface(), device), margin_m)
        self._too_close_m = volume.config.voxel_size_m / 2

    @classmethod
    def from_inputs(cls, inputs: OcclusionInputs) -> TsdfOcclusion:
        """Make the model from the volume that the depth images fuse to."""
        return cls(inputs.tsdf_volume, inputs.occlusion_config.margin_m, inputs.device)

    def inside_geometry(self, locations: Float) -> NDArray[np.bool_]:
        """Whether locations (L, 3) m are within half a voxel of a surface, or behind surfaces; (L,).

        A location is behind surfaces if more of the 32 rays around it meet a back than a front: it is in furniture or a
        wall, or outside of the observed space. If no ray meets a surface, the location counts as free.
        """
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        fronts, backs = self._sides_seen(at)
        behind = backs.sum(1) > fronts.sum(1)
        close = self.raycaster.distance_to_surface(at, self._too_close_m) <= self._too_close_m
        return np.asarray(behind | close)
