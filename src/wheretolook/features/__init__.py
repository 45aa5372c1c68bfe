"""Keypoints and their descriptors: extraction and matching."""
