"""Procedural apartments: the scenes that are there without any download."""

from wheretolook.scenes.procedural.generator import ApartmentConfig, generate_apartment

__all__ = ["ApartmentConfig", "generate_apartment"]
