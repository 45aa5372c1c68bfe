"""Comparison of paths planned by several methods."""
