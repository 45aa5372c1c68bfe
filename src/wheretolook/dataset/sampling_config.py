"""Options of sampling viewpoints, apart from the code that does it, so that the command line reads them quickly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from wheretolook.geometry.lattices import Lattice, ViewLattice
from wheretolook.utils.errors import ConfigError, check_range, no_option

Split = Literal["train", "val", "test"]  # scenes for training, validation and testing


@dataclass(frozen=True)
class SampleConfig(ViewLattice):
    """Settings of the sample stage.

    Args:
        keep: directions kept at each location, those that see most landmarks; 0 keeps all. The paper's K.
        min_visible: directions that see fewer landmarks are dropped. In the paper, those with "none or only a minimal
            number" (Sec. 3.2).
        max_locations: free locations to keep at most, drawn at random; 0 keeps all.
        max_directions: kept directions of each location to take at most, drawn at random; 0 takes all. One number, or
            one for each split, such as `{train: 50, val: 50, test: 100}`.
        seed: seed of what is drawn at random.
        cameras: number of cameras of a scene, each used at its own locations, with fields of view, sizes and aspect
            ratios drawn from the scene's seed; 0 uses the experiment's camera everywhere.
        near_map: share of `max_locations`, 0 to 1, that is near mapping images, with directions near theirs, as
            photographs of a sequence are to each other; needs a grid of about 20 cm.

    Attributes:
        distinct_pixels: recorded with samples; landmarks are counted, and `wheretolook_paper.visibility` counts pixels.
        memory_gb: bound on the memory that counting takes on its device, in 10^9 bytes; two million landmarks fit.
    """

    lattice: Lattice = no_option("fibonacci")
    keep: int = 100
    min_visible: int = no_option(1)
    max_locations: int = 0
    max_directions: int | dict[Split, int] = 0
    seed: int = 0
    cameras: int = 0
    near_map: float = 0.0
    distinct_pixels: bool = field(default=False, init=False)
    memory_gb: float = field(default=2.0, init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("keep", "min_visible", "max_locations", "cameras"):
            check_range(f"sample.{name}", getattr(self, name), 0)
        check_range("sample.near_map", self.near_map, 0, 1)
        if self.near_map and not self.max_locations:
            fix = "Set sample.max_locations."
            raise ConfigError("near_map is a share of max_locations, which is 0", value=self.near_map, fix=fix)
        if isinstance(self.max_directions, dict) and set(self.max_directions) != set(get_args(Split)):
            fix = "Give one number, or one for each of train, val and test."
            raise ConfigError("sample.max_directions lacks or misnames a split", value=self.max_directions, fix=fix)
        check_range("sample.max_directions", min(map(self.directions_of, get_args(Split))), 0)

    def directions_of(self, split: Split) -> int:
        """`max_directions` for a split."""
        return self.max_directions[split] if isinstance(self.max_directions, dict) else self.max_directions
