"""Options of drawing figures and tables from logged runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from wheretolook.figures import KINDS
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class FiguresConfig:
    """Options of the figures stage.

    Args:
        out: output folder; `<dataset>/results/figures` by default.
        only: names of the figures and tables to draw, as listed by `wheretolook figures --list`; all by default.
        kinds: file formats of figures: png, pdf, svg.
    """

    out: Path | None = None
    only: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ("png", "pdf")

    def __post_init__(self) -> None:
        if not self.kinds or not set(self.kinds) <= set(KINDS):
            raise ConfigError("unknown kind of figure", value=self.kinds, fix=f"Use some of {', '.join(KINDS)}.")
