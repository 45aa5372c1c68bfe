"""Poses, cameras, lattices of directions and voxels, meshes, depth images fused to a surface."""
