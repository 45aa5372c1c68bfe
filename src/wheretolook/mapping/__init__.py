"""COLMAP maps: built from images rendered along a walk or from photographs, or read from any COLMAP model."""
