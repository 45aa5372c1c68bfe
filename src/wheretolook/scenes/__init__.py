"""Scenes: textured meshes, where they come from, and where a camera can be in them."""
