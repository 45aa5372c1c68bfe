"""Depth images of a scene, rendered instead of taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.visibility.tsdf import DepthImage


class RenderedDepth(Sequence[DepthImage]):
    """Depth images of poses (B, 3, 4), each rendered when it is asked for."""

    def __init__(self, renderer: WarpRenderer, camera: Camera, cam_from_world: Float) -> None:
        self.renderer, self.camera, self.cam_from_world = renderer, camera, cam_from_world

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @overload
    def __getitem__(self, index: int) -> DepthImage: ...
    @overload
    def __getitem__(self, index: slice) -> RenderedDepth: ...
    def __getitem__(self, index: int | slice) -> DepthImage | RenderedDepth:
        if isinstance(index, slice):
            return RenderedDepth(self.renderer, self.camera, self.cam_from_world[index])
        pose = self.cam_from_world[index]
        return DepthImage(self.renderer.render(self.camera, pose[None]).depth_m[0], self.camera, pose)
