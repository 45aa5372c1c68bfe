"""Options of all commands in one, and running a command with those that it has."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from wheretolook.commands.demo import Demo
from wheretolook.commands.map import BuildMap
from wheretolook.commands.options import select_options
from wheretolook.commands.viewpoint_map import BuildViewpointMap
from wheretolook.planning.config import PlanConfig


@dataclass(frozen=True, kw_only=True)
class AllOptions(Demo):
    """Options of every command that works on a dataset; `source` and `views` have those of `map` and `viewpoint-map` that others would take for theirs."""

    plan: PlanConfig = field(default_factory=PlanConfig)
    release_name: str = "release"
    source: dict[str, Any] = field(default_factory=dict)
    views: dict[str, Any] = field(default_factory=dict)


def run(command, options, log=lambda line: None):
    """Run a command with those of the options that it has."""
    given = {BuildMap: options.source, BuildViewpointMap: options.views}.get(command, {})
    return select_options(command, options, **given).run(log)
