"""All that is fuzzed: what each target reads, and the whole files from which it begins, written by code."""

from __future__ import annotations

from faults.fuzz import dataset_targets, map_targets, mesh_targets, text_targets
from faults.fuzz.execution import Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (text_targets, dataset_targets, map_targets, mesh_targets)
    for target in module.TARGETS
}
"""By their names."""
