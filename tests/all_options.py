"""Options of all commands in one, and running a command with those that it has."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from wheretolook.commands.demo import Demo
from wheretolook.commands.map import BuildMap
from wheretolook.commands.options import select_options
from wheretolook.planning.config import PlanConfig, ViewpointMapConfig


@dataclass(frozen=True, kw_only=True)
class AllOptions(Demo):
    """Options of every command that works on a dataset; `source` has those of `Map` that others would take for theirs."""

    viewpoint_map: ViewpointMapConfig = field(default_factory=ViewpointMapConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    release_name: str = "release"
    source: dict[str, Any] = field(default_factory=dict)


def run(command, options, log=lambda line: None):
    """Run a command with those of the options that it has."""
    given = options.source if command is BuildMap else {}
    return select_options(command, options, **given).run(log)
