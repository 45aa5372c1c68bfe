"""All extractors, by name."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module

from wheretolook.features.extractor import DescriptorKind, Extractor

MODULES = ("sift", "learned_extractors")
"""Modules of `wheretolook.features` that define `EXTRACTORS`."""


@cache
def all_extractors() -> Mapping[str, Extractor]:
    """Every extractor by its name."""
    modules = (import_module(f"wheretolook.features.{module}") for module in MODULES)
    return {extractor.name: extractor for module in modules for extractor in module.EXTRACTORS}


def runnable_extractors() -> tuple[str, ...]:
    """Names of the extractors that can be run."""
    return tuple(name for name, extractor in all_extractors().items() if extractor.build is not None)


@cache
def all_kinds() -> Mapping[str, DescriptorKind]:
    """Every kind of descriptors by its name."""
    kinds = (extractor.descriptors for extractor in all_extractors().values())
    return {kind.name: kind for kind in kinds}


def kind_of(method: str) -> DescriptorKind:
    """The descriptors of an extractor by its name."""
    return all_extractors()[method].descriptors
