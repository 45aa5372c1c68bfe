"""Options of drawing figures and tables from logged runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheretolook.utils.errors import ConfigError

Look = dict[str, Any]  # keyword arguments of Matplotlib's functions, such as colours and sizes
KINDS = ("png", "pdf", "svg")  # kinds of files that figures are written as


@dataclass(frozen=True)
class FiguresConfig:
    """Options of the figures stage.

    Args:
        out: folder of the files; `<dataset>/results/figures` if not given.
        only: names of what to draw, as `wheretolook figures --list` tells; empty for all.
        kinds: kinds of files of a figure: png, pdf, svg.
    """

    out: Path | None = None
    only: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ("png", "pdf")

    def __post_init__(self) -> None:
        if not self.kinds or not set(self.kinds) <= set(KINDS):
            raise ConfigError("unknown kind of figure", value=self.kinds, fix=f"Use some of {', '.join(KINDS)}.")
