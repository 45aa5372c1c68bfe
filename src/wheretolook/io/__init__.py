"""File formats of poses and depth images."""
