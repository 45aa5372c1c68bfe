"""Options of sampling viewpoints, apart from the code that does it, so that the command line reads them quickly."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from wheretolook.geometry.lattices import Lattice
from wheretolook.utils.errors import ConfigError

Split = Literal["train", "val", "test"]
"""What a scene is for: to learn from, to choose by, to report on."""


@dataclass(frozen=True)
class SampleConfig:
    """Settings of the sample stage.

    Args:
        grid: voxels along x, y and z over the scene's bounds; the paper has 8 x 8 x 8.
        directions: directions at each location; the released code has 500.
        lattice: how they are spread: "fibonacci" is even, "azimuth-elevation" is the paper's comparison, "released" is
            what the released code does, "yaw-pitch" are ActLoc's 6 pitches x 18 yaws, whatever `directions` says.
        keep: directions kept at each location, those that see most landmarks; 0 keeps all. The paper's K.
        min_visible: directions that see fewer landmarks are dropped. In the paper, those with "none or only a minimal
            number" (Sec. 3.2).
        max_locations: a random subset of the free locations, 0 for all.
        max_directions: a random subset of the kept directions of each location, 0 for all; one number, or one for
            each split, such as `{train: 50, val: 50, test: 100}`.
        seed: seed of the random subsets.
        distinct_pixels: rank by the number of distinct pixels with a landmark, as the released code counts, instead of
            the number of landmarks.

    Attributes:
        memory_gb: bound on the memory that counting takes on its device, in 10^9 bytes; two million landmarks fit.
    """

    grid: tuple[int, int, int] = (8, 8, 8)
    directions: int = 500
    lattice: Lattice = "fibonacci"
    keep: int = 100
    min_visible: int = 1
    max_locations: int = 0
    max_directions: int | dict[Split, int] = 0
    seed: int = 0
    distinct_pixels: bool = False
    memory_gb: float = field(default=2.0, init=False)

    def __post_init__(self) -> None:
        for name in ("keep", "min_visible", "max_locations"):
            if getattr(self, name) < 0:
                raise ConfigError(f"sample.{name} must not be negative", value=getattr(self, name))
        if isinstance(self.max_directions, dict) and set(self.max_directions) != set(get_args(Split)):
            fix = "Give one number, or one for each of train, val and test."
            raise ConfigError("sample.max_directions lacks or misnames a split", value=self.max_directions, fix=fix)
        if min(map(self.directions_of, get_args(Split))) < 0:
            raise ConfigError("sample.max_directions must not be negative", value=self.max_directions)

    def directions_of(self, split: Split) -> int:
        """`max_directions` for a split."""
        return self.max_directions[split] if isinstance(self.max_directions, dict) else self.max_directions
