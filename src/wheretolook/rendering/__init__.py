"""RGB and depth of batches of poses, and ray queries, on a textured triangle mesh."""
