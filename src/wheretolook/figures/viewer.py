"""The interactive view: a scene, its map, cameras and a path in Open3D's viewer."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike, NDArray

from wheretolook.figures.dollhouse import BLUE, ORANGE, VERMILION, frustum_segments
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float
from wheretolook.scenes.cutting import cut_above

FRUSTUM_M = 0.25
"""Depth of the cameras that are drawn."""

_POINT_PX = 3


def scene_geometries(
    mesh: TexturedMesh | None = None,
    landmarks: ArrayLike | None = None,
    cameras: ArrayLike | None = None,
    path: ArrayLike | None = None,
    camera: PinholeCamera = PinholeCamera(),
    cut_m: float | None = None,
) -> list[dict[str, Any]]:
    """What Open3D's viewer draws, each geometry with a name that the viewer lists, to be shown and hidden.

    Args:
        mesh: metres, z up; one geometry for each of its textures.
        landmarks: (N, 3) metres.
        cameras: cam_from_world (B, 3, 4).
        path: (P, 3) metres.
        camera: intrinsics of the cameras.
        cut_m: what of the mesh lies above this height is left out, so that one can look in.

    Returns:
        Arguments of `open3d.visualization.draw`: `name`, `geometry` and `material` of each.
    """
    found: list[dict[str, Any]] = []
    if mesh is not None:
        found += _mesh_geometries(mesh if cut_m is None else cut_above(mesh, cut_m))
    if landmarks is not None:
        found.append(_points("landmarks", np.asarray(landmarks, dtype=np.float64), ORANGE))
    if cameras is not None:
        segments = frustum_segments(camera, cameras, FRUSTUM_M).reshape(-1, 2, 3)
        found.append(_lines("cameras", segments, BLUE, 1.5))
    if path is not None:
        at = np.asarray(path, dtype=np.float64)
        found.append(_lines("path", np.stack([at[:-1], at[1:]], axis=1), VERMILION, 4.0))
    return found


def show_scene(
    mesh: TexturedMesh | None = None,
    landmarks: ArrayLike | None = None,
    cameras: ArrayLike | None = None,
    path: ArrayLike | None = None,
    camera: PinholeCamera = PinholeCamera(),
    cut_m: float | None = None,
    title: str = "wheretolook",
) -> None:
    """Open a window with the scene and return when it is closed; a display is needed. Else as `scene_geometries`."""
    import open3d as o3d

    geometries = scene_geometries(mesh, landmarks, cameras, path, camera, cut_m)
    o3d.visualization.draw(geometries, title=title, show_skybox=False, bg_color=(1.0, 1.0, 1.0, 1.0))


def _mesh_geometries(mesh: TexturedMesh) -> list[dict[str, Any]]:
    import open3d as o3d

    found = []
    for number, texture in enumerate(mesh.textures):
        rows = np.flatnonzero(mesh.triangle_texture == number)
        if len(rows) == 0:
            continue
        # a corner of its own for each triangle, so that texture coordinates belong to vertices
        corners = mesh.triangles[rows].reshape(-1)
        part = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(mesh.vertices[corners].astype(np.float64)),
            o3d.utility.Vector3iVector(np.arange(len(corners), dtype=np.int32).reshape(-1, 3)),
        )
        uvs = mesh.corner_uvs[rows].reshape(-1, 2).astype(np.float64)
        part.triangle_uvs = o3d.utility.Vector2dVector(np.column_stack([uvs[:, 0], 1 - uvs[:, 1]]))  # v up
        if mesh.vertex_colors is not None:
            part.vertex_colors = o3d.utility.Vector3dVector(mesh.vertex_colors[corners] / 255.0)
        material = _material("defaultUnlit")
        material.albedo_img = o3d.geometry.Image(np.ascontiguousarray(texture))  # type: ignore[call-overload]
        found.append(_named("mesh" if len(mesh.textures) == 1 else f"mesh {number + 1}", part, material))
    return found


def _points(name: str, points: Float, color: str) -> dict[str, Any]:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.paint_uniform_color(np.array(to_rgb(color)))
    material = _material("defaultUnlit")
    material.point_size = _POINT_PX
    return _named(name, cloud, material)


def _lines(name: str, segments: NDArray[np.floating[Any]], color: str, width_px: float) -> dict[str, Any]:
    import open3d as o3d

    lines = o3d.geometry.LineSet(
        o3d.utility.Vector3dVector(segments.reshape(-1, 3).astype(np.float64)),
        o3d.utility.Vector2iVector(np.arange(2 * len(segments), dtype=np.int32).reshape(-1, 2)),
    )
    lines.paint_uniform_color(np.array(to_rgb(color)))
    material = _material("unlitLine")
    material.line_width = width_px
    return _named(name, lines, material)


def _material(shader: str) -> Any:
    import open3d as o3d

    material = o3d.visualization.rendering.MaterialRecord()
    material.shader = shader
    return material


def _named(name: str, geometry: Any, material: Any) -> dict[str, Any]:
    return {"name": name, "geometry": geometry, "material": material}
