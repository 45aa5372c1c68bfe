"""A scene, its landmarks and cameras in Open3D's interactive viewer."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from matplotlib.colors import to_rgb

from wheretolook.figures.floor_plan import BLUE
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh, cut_above
from wheretolook.geometry.poses import Float
from wheretolook.view.drawing import frustum_segments
from wheretolook_paper.figures.style import ORANGE


def show_scene(mesh: TexturedMesh, landmarks: Float, cameras: Float | None, cut_m: float = np.inf) -> None:
    """Show a scene in a window until that is closed. Needs a display.

    Draws the mesh (metres, z up) below the height `cut_m`, landmarks (N, 3) m, and `cameras`, cam_from_world (B, 3, 4).
    """
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(landmarks))
    cloud.paint_uniform_color(np.array(to_rgb(ORANGE)))
    geometries = [*_mesh_geometries(cut_above(mesh, cut_m)), _named("landmarks", cloud, "defaultUnlit", point_size=3)]
    if cameras is not None:
        segments = frustum_segments(PinholeCamera(), cameras, depth_m=0.25).reshape(-1, 3)
        lines = o3d.geometry.LineSet(
            o3d.utility.Vector3dVector(segments.astype(np.float64)),
            o3d.utility.Vector2iVector(np.arange(len(segments), dtype=np.int32).reshape(-1, 2)),
        )
        lines.paint_uniform_color(np.array(to_rgb(BLUE)))
        geometries.append(_named("cameras", lines, "unlitLine", line_width=1.5))
    o3d.visualization.draw(geometries, title="wheretolook", show_skybox=False, bg_color=(1.0, 1.0, 1.0, 1.0))


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


def _named(name: str, geometry: Any, shader: str, **properties: Any) -> dict[str, Any]:
    material = o3d.visualization.rendering.MaterialRecord()
    for key, value in {"shader": shader, **properties}.items():
        setattr(material, key, value)
    return {"name": name, "geometry": geometry, "material": material}
