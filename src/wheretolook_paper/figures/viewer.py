"""A scene, its map, cameras and a path in Open3D's interactive viewer."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike, NDArray

from wheretolook.figures.dollhouse import frustum_segments
from wheretolook.figures.style import BLUE, ORANGE, VERMILION
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.scenes.cutting import cut_above

FRUSTUM_M = 0.25  # depth of the cameras that are drawn

_POINT_PX = 3


def scene_geometries(
    mesh: TexturedMesh | None = None,
    landmarks: ArrayLike | None = None,
    cameras: ArrayLike | None = None,
    path: ArrayLike | None = None,
    camera: PinholeCamera = PinholeCamera(),
    cut_m: float | None = None,
) -> list[dict[str, Any]]:
    """Return the `name`, `geometry` and `material` of each part of a scene, for `open3d.visualization.draw`.

    There is a geometry for each texture of the mesh (metres, z up), of which what lies above `cut_m` is left out; for
    landmarks (N, 3) m; for `cameras`, cam_from_world (B, 3, 4), with intrinsics `camera`; and for the path (P, 3) m.
    """
    found: list[dict[str, Any]] = []
    if mesh is not None:
        found += _mesh_geometries(mesh if cut_m is None else cut_above(mesh, cut_m))
    if landmarks is not None:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(landmarks, dtype=np.float64)))
        cloud.paint_uniform_color(np.array(to_rgb(ORANGE)))
        found.append(_named("landmarks", cloud, "defaultUnlit", point_size=_POINT_PX))
    if cameras is not None:
        segments = frustum_segments(camera, cameras, FRUSTUM_M).reshape(-1, 2, 3)
        found.append(_lines("cameras", segments, BLUE, 1.5))
    if path is not None:
        at = np.asarray(path, dtype=np.float64)
        found.append(_lines("path", np.stack([at[:-1], at[1:]], axis=1), VERMILION, 4.0))
    return found


def show_scene(*parts: Any, title: str = "wheretolook", **named_parts: Any) -> None:
    """Show a scene in a window until that is closed. Needs a display. Arguments are those of `scene_geometries`."""
    geometries = scene_geometries(*parts, **named_parts)
    o3d.visualization.draw(geometries, title=title, show_skybox=False, bg_color=(1.0, 1.0, 1.0, 1.0))


def _mesh_geometries(mesh: TexturedMesh) -> list[dict[str, Any]]:
    found = []
    for number, texture in enumerate(mesh.textures):
        rows = np.flatnonzero(mesh.triangle_texture == number)
        if len(rows) == 0:
            continue
        # triangles share no vertices here, so that each vertex has texture coordinates
        corners = mesh.triangles[rows].reshape(-1)
        part = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(mesh.vertices[corners] + mesh.origin),
            o3d.utility.Vector3iVector(np.arange(len(corners), dtype=np.int32).reshape(-1, 3)),
        )
        uvs = mesh.corner_uvs[rows].reshape(-1, 2).astype(np.float64)
        part.triangle_uvs = o3d.utility.Vector2dVector(np.column_stack([uvs[:, 0], 1 - uvs[:, 1]]))  # v up
        if mesh.vertex_colors is not None:
            part.vertex_colors = o3d.utility.Vector3dVector(mesh.vertex_colors[corners] / 255.0)
        image = o3d.geometry.Image(np.ascontiguousarray(texture))  # type: ignore[call-overload]
        name = "mesh" if len(mesh.textures) == 1 else f"mesh {number + 1}"
        found.append(_named(name, part, "defaultUnlit", albedo_img=image))
    return found


def _lines(name: str, segments: NDArray[np.floating[Any]], color: str, width_px: float) -> dict[str, Any]:
    lines = o3d.geometry.LineSet(
        o3d.utility.Vector3dVector(segments.reshape(-1, 3).astype(np.float64)),
        o3d.utility.Vector2iVector(np.arange(2 * len(segments), dtype=np.int32).reshape(-1, 2)),
    )
    lines.paint_uniform_color(np.array(to_rgb(color)))
    return _named(name, lines, "unlitLine", line_width=width_px)


def _named(name: str, geometry: Any, shader: str, **properties: Any) -> dict[str, Any]:
    material = o3d.visualization.rendering.MaterialRecord()
    for key, value in {"shader": shader, **properties}.items():
        setattr(material, key, value)
    return {"name": name, "geometry": geometry, "material": material}
