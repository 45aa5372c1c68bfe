"""RGB and depth of batches of poses, and ray queries, on a textured triangle mesh.

`WarpRenderer` is the renderer of the project, on CUDA and on the CPU; `Open3DRenderer` computes the same images with
Open3D and NumPy and is its reference."""
