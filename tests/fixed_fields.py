"""Run commands with other values of fields that the command line does not set, such as small scenes of few rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any
from unittest.mock import patch

from wheretolook import cli

FAST = {
    "scenes.apartment.n_rooms": 3,
    "scenes.apartment.area_m2": 26,
    "scenes.apartment.texture_size": 1024,
    "scenes.apartment.texels_per_m": 40,
    "scenes.apartment.light_spacing_m": 0.5,
    "scenes.apartment.light_rays": 4,
    "train.val_fraction": 0.3,
    "evaluate.resamples": 20,
    "evaluate.top_n": (1,),
}
"""A small dataset, trained and evaluated in seconds."""


def with_fields(options: Any, values: Mapping[str, Any]) -> Any:
    """Return options with the values of fields by their dotted names, as far as there are such fields."""
    for name, value in values.items():
        field, _, rest = name.partition(".")
        if hasattr(options, field):
            inner = getattr(options, field)
            options = replace(options, **{field: with_fields(inner, {rest: value}) if rest else value})
    return options


def main(arguments: Sequence[str], values: Mapping[str, Any] = FAST) -> int:
    """Run the command line with other values of fields that it does not set; returns the exit code."""
    parse = cli.parse_command
    with patch.object(cli, "parse_command", lambda name, rest: with_fields(parse(name, rest), values)):
        return cli.main(arguments)
