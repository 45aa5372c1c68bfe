"""The renderers by name."""

from __future__ import annotations

from pkgutil import resolve_name
from typing import TYPE_CHECKING

from wheretolook.utils.validation import check_choice

if TYPE_CHECKING:
    from wheretolook.geometry.mesh import TexturedMesh
    from wheretolook.rendering.warp_renderer import Renderer

RENDERERS = {"warp": "wheretolook.rendering.warp_renderer:WarpRenderer"}
"""Classes of renderers, constructed with a mesh and a device."""


def make_renderer(mesh: TexturedMesh, device: str = "cpu", name: str = "warp") -> Renderer:
    """Make a renderer of a mesh on "cpu" or a CUDA device. Raises ConfigError if there is none of that name."""
    check_choice("renderer", name, RENDERERS)
    renderer: Renderer = resolve_name(RENDERERS[name])(mesh, device)
    return renderer
