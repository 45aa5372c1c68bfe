"""Scenes: textured triangle meshes in metres, z up, and the free space in them."""
