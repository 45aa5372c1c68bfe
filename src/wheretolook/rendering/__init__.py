"""RGB and depth of batches of poses, and ray queries, on a textured triangle mesh.

`WarpRenderer` is the renderer of the project, on CUDA and on the CPU; `Open3DRenderer` computes the same images with
Open3D and NumPy and is its reference.
"""

from wheretolook.rendering.open3d_renderer import Open3DRenderer
from wheretolook.rendering.raycasting import MeshRaycaster, RayHits
from wheretolook.rendering.types import Renderer, Rendering
from wheretolook.rendering.warp_renderer import WarpRenderer

__all__ = ["MeshRaycaster", "Open3DRenderer", "RayHits", "Renderer", "Rendering", "WarpRenderer"]
