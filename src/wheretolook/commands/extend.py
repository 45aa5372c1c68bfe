"""`wheretolook extend`: the photographs to take next, so that most views of a robot localize in the map."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.select import SelectorOptions
from wheretolook.extend.config import TargetOptions, check_extension
from wheretolook.geometry.views import check_format
from wheretolook.select.waypoints import given_waypoints
from wheretolook.utils.errors import no_option

if TYPE_CHECKING:
    from wheretolook.extend.plan import Extension


@dataclass(frozen=True, kw_only=True)
class Extend(TargetOptions, SelectorOptions):
    """Plan the photographs to take next, so that most views that a robot will have localize in your COLMAP model.

    Photographs come in pairs, since a landmark needs two images; one of each pair registers in the map so far, also if
    the rest of the list is not taken. Take them in the order of the list.

    Where the robot will be (--targets): a file of `wheretolook select --at`, or x,y,z, any number of them; by default all
    free space at --height. Photographs are anywhere in free space, by --mesh or --depth, or else near the mapping cameras,
    and are planned for the map's camera. Without mesh or depth, the surface is known only at landmarks, and
    elsewhere assumed at their usual distance: unmapped rooms cannot be planned for.

    Columns of --out (formats as of `wheretolook select`): gain in the predicted share of target views that localize; share
    after the photograph, with the 95 % interval over places; p_registers, the probability that the photograph registers;
    its partner; overlaps, the images that show most of the same.

    Examples:
      wheretolook extend --map sparse/0 --mesh house.glb --n 10 --out photographs.csv --floor-plan photographs.png
      wheretolook view --map sparse/0 --mesh house.glb --path photographs.csv
      wheretolook extend --map sparse/0 --scale 1 --n 20 --until 0.9 --out photographs.tum
      wheretolook extend --map sparse/0 --mesh house.glb --targets path.tum --height 0.4 --pitch 0 20 --out images.txt

    Args:
        n: number of photographs.
        at: where the robot will be: a file, or x,y,z, any number of them.
        least_score: share of target views that localize at which the list ends.
        least_p: least probability that one photograph of a pair registers.
    """

    SHORT: ClassVar = {
        "targets": "at",
        "height": "height_m",
        "pitch": "pitch_deg",
        "pan": "pan_deg",
        "until": "least_score",
    }

    n: int = 10
    at: tuple[str, ...] = ()
    least_score: float = 1.0
    least_p: float = no_option(0.3)

    def __post_init__(self) -> None:
        TargetOptions.__post_init__(self)
        SelectorOptions.__post_init__(self)
        check_extension(self.n, self.least_score, self.least_p)
        check_format(self.out, self.format, 1)

    def run(self) -> Extension:
        """Plan the photographs, write them to `out` and print a summary."""
        from wheretolook.extend.report import heat_maps, percent
        from wheretolook.figures.floor_plan import save_figure

        start = time.monotonic()
        at = given_waypoints(self.at, self.frame) if self.at else None
        look = self.open_map()
        options = {name: getattr(self, name) for name in TargetOptions.__dataclass_fields__}
        plan = look.extend(self.n, at, until=self.least_score, least_p=self.least_p, **options)
        plan.views.save(self.out, self.format)
        before = float(plan.targets.score.mean())
        after = float(plan.predicted.mean())
        if self.floor_plan is not None:
            maps = {
                f"now: {100 * before:.0f} %": (plan.targets, plan.targets.score),
                f"predicted: {100 * after:.0f} %": (plan.targets, plan.predicted),
            }
            points = look.localization_map.landmarks.points
            save_figure(heat_maps(points, maps, look.frame, plan.views), self.floor_plan)
            print(f"floor plan: {self.floor_plan}")
        print(look.frame.describe())
        for doubt in look.frame.doubts:
            print(doubt)
        print(f"surface: {plan.surface}; correlation of covered surface and scores: {plan.correlation:.2f}")
        print(
            f"target views that localize: {100 * before:.1f} % of {len(plan.targets)} now, predicted {100 * after:.1f} %"
        )
        views = plan.views
        for row, name in enumerate(views.waypoint_id):
            share = percent(views.share[row], views.share_low[row], views.share_high[row])
            partner = f", with {views.partner[row]}" if views.partner[row] else ""
            text = f"P registers {views.p_registers[row]:.2f}{partner}; overlaps {views.overlaps[row] or 'its partner only'}"
            print(f"{name:>3}: {share}; {text}")
        if after >= self.least_score:
            print(f"{100 * self.least_score:g} % are reached after {len(views)} photographs")
        elif len(views) < self.n:
            print(f"{len(views)} of {self.n} photographs: further ones gain nothing, or do not register")
        print(f"photographs: {len(views)} in {time.monotonic() - start:.1f} s: {self.out}")
        return plan
