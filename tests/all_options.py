"""Options of all commands in one, and running a command with those that it has."""

from __future__ import annotations

from dataclasses import dataclass, field

from wheretolook.commands.demo import Demo
from wheretolook.commands.options import select_options
from wheretolook.planning.config import PlanConfig, ViewpointMapConfig


@dataclass(frozen=True, kw_only=True)
class AllOptions(Demo):
    """Options of every command that works on a dataset."""

    viewpoint_map: ViewpointMapConfig = field(default_factory=ViewpointMapConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    release_name: str = "release"


def run(command, options, log=lambda line: None):
    """Run a command with those of the options that it has."""
    return select_options(command, options).run(log)
