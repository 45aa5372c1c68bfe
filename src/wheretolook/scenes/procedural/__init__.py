"""Procedural apartments: the scenes that are there without any download."""
