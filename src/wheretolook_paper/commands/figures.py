"""`wheretolook figures`: every figure and table, drawn from logged runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.options import DatasetOptions, Log
from wheretolook.dataset.dataset_lock import reads_dataset
from wheretolook.figures import KINDS
from wheretolook.tracking import TrackingConfig
from wheretolook.utils.errors import ConfigError, MissingRunError

if TYPE_CHECKING:
    from wheretolook.dataset.layout import Dataset


@dataclass(frozen=True, kw_only=True)
class Figures(DatasetOptions):
    """Draw every figure and table of the paper, and others, from logged runs.

    `wheretolook figures --list` lists them. Each file names the runs that it was drawn from, and is attached to them as
    an artifact under figures/. Where a run is missing, the command that makes it is named and the others are drawn; if
    one of the paper's, or one named with --only, is missing, the exit code is 2. Without --config it is
    configs/release.yaml, whose runs are logged first. Tables are CSV, Markdown and TeX.

    Examples:
      wheretolook figures --only '[top_n, runtimes]' --kinds '[svg]'

    Args:
        out: output folder; `<dataset>/results/figures` by default.
        only: names of the figures and tables to draw, as listed by `wheretolook figures --list`; all by default.
        kinds: file formats of figures: png, pdf, svg.
        tracking: where MLflow keeps its runs.
        list: only list the figures and tables.
    """

    CONFIG: ClassVar = "release"
    LISTING: ClassVar = "list"

    out: Path | None = None
    only: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ("png", "pdf")
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    list: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.kinds or not set(self.kinds) <= set(KINDS):
            raise ConfigError("unknown kind of figure", value=self.kinds, fix=f"Use some of {', '.join(KINDS)}.")

    def run(self, log: Log = print) -> Dataset | None:
        """Draw every figure and table from logged runs; those of a release are logged first. Or list them.

        Raises:
            MissingRunError: a figure of the paper, or one named in `only`, has no run to be drawn from. All
                others were drawn.
            ConfigError: there is no figure of that name. TableError: there is no dataset.
        """
        if self.list:
            from wheretolook_paper.release.catalog import catalog_text

            return print(catalog_text())
        return self._draw(log)

    @reads_dataset("figures")
    def _draw(self, log: Log) -> Dataset:
        from wheretolook.dataset.layout import Dataset

        dataset = Dataset.load(self.root)
        from wheretolook_paper.commands.log_release import log_release
        from wheretolook_paper.release.catalog import ITEMS, check_names, write_items
        from wheretolook_paper.release.copy import is_release

        check_names(self.only)
        if is_release(dataset):
            log_release(dataset, self.tracking, log, attach=False)
        out = self.out or dataset.root / "results" / "figures"
        missing = write_items(dataset, self.tracking, out, self.only, self.kinds, log)
        wanted = self.only or [item.name for item in ITEMS if item.paper]
        needed = {name: command for name, command in missing.items() if name in wanted}
        if needed:
            fix = "Run " + "; ".join(dict.fromkeys(needed.values()))
            raise MissingRunError("not all figures could be drawn", value=", ".join(needed), fix=fix)
        return dataset
