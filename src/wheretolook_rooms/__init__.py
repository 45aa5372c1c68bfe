"""Textured rooms generated from a seed: apartments, halls, courts, offices and buildings.

Frozen: the labels that ship depend on every random draw, so no draw may change.
"""

from wheretolook_rooms.generator import generate_scene as generate

__all__ = ["generate"]
