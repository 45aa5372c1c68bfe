"""Poses, cameras, lattices of directions and voxels, meshes."""
