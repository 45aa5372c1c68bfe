"""The picture beside a view: rendered, or the nearest photograph, or the landmarks alone."""

from __future__ import annotations

from wheretolook.geometry.poses import Float
from wheretolook.view import drawing
from wheretolook.view.opened import Opened
from wheretolook.view.scores import SeenLandmarks


def picture_of(opened: Opened, pose: Float, seen: SeenLandmarks) -> tuple[drawing.Rgb, str]:
    """What a view (3, 4) shows, (H, W, 3), and what kind of picture it is.

    Landmarks in view are marked in the colours of their chances, but not on a photograph, which shows another view.
    """
    camera = opened.camera
    if opened.renderer is not None:
        rgb = opened.renderer.render(drawing.small_camera(camera), pose[None]).rgb[0]
        return drawing.picture(rgb, camera, seen.pixels, seen.chances), "rendered; landmarks by their chance"
    if opened.photographs is not None:
        number = opened.photographs.nearest(pose)
        rgb = opened.photographs.read(number, drawing.PICTURE_PX)
        return rgb, f"nearest photograph, {opened.photographs.names[number]}"
    return drawing.picture(None, camera, seen.pixels, seen.chances), "landmarks in view by their chance"
