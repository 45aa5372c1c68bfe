"""`wheretolook audit`: how much of a place localizes, from the map alone."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.select import OpenOptions
from wheretolook.extend.config import TargetOptions
from wheretolook.mapping.colmap_model import model_suffix
from wheretolook.mapping.config import place_name
from wheretolook.select.waypoints import given_waypoints

if TYPE_CHECKING:
    from wheretolook.extend.audit import Audit


@dataclass(frozen=True, kw_only=True)
class AuditMap(TargetOptions, OpenOptions):
    """Audit a map: how many of the views that a robot will have localize, where they do not, and why. No photographs needed.

    Target views are at the places given (--targets: a file of `wheretolook select --at`, or x,y,z), else in all free
    space: by --mesh or --depth at --height, or else near the mapping cameras. Their yaws are random, with --pan relative to
    the headings of the places given. The share is the mean of their scores.

    Results (--out):
      audit.csv    one row for each place: its share, and the weak region that it is in, with the cause: too far, too
                   oblique, repeated, few landmarks, or nothing mapped
      audit.json   the share with its 95 % interval over places, and the weak regions; audit.png shows the places
      mounts.csv   the share for each height and pitch of a fixed camera, if several are given; mounts.png shows them

    Examples:
      wheretolook audit --map sparse/0 --out audit
      wheretolook audit --map sparse/0 --against sparse/new --mesh house.glb --out audit
      wheretolook audit --map sparse/0 --mesh house.glb --mount 0.3 0.8 1.5 --pitch -20 20 --out audit

    Args:
        out: folder of the results.
        at: where the robot will be: a file, or x,y,z, any number of them.
        against: another map of the place, in the same frame.
    """

    SHORT: ClassVar = {
        "targets": "at",
        "height": "height_m",
        "mount": "height_m",
        "pitch": "pitch_deg",
        "pan": "pan_deg",
        "other": "against",
    }
    WRITES: ClassVar[str] = "audit.json"

    out: Path
    at: tuple[str, ...] = ()
    against: Path | None = None

    def __post_init__(self) -> None:
        TargetOptions.__post_init__(self)
        OpenOptions.__post_init__(self)

    def run(self) -> dict[str, Audit]:
        """Audit the map, write the results to `out` and print a summary."""
        from wheretolook.extend.audit import compare_mounts
        from wheretolook.extend.report import percent, save_audits

        start = time.monotonic()
        if self.against is not None:
            model_suffix(self.against)
        at = given_waypoints(self.at) if self.at else None
        maps = [self.map] if self.against is None else [self.map, self.against]
        named = {place_name(path): path for path in maps}
        if len(named) < len(maps):
            named = {str(path): path for path in maps}
        looks = {name: self.open_map(path) for name, path in named.items()}
        options = {name: getattr(self, name) for name in TargetOptions.__dataclass_fields__}
        look = next(iter(looks.values()))
        audit = look.audit(at, **options)
        audits = {name: audit if other is look else other.audit(audit) for name, other in looks.items()}
        mounts = compare_mounts(lambda **mount: look.audit(at, **{**options, **mount}), self)
        save_audits(audits, mounts, look.localization_map.landmarks.points, self.out)
        print(look.frame.describe())
        for name, audit in audits.items():
            print(f"{name}: {percent(audit.share, *audit.interval)} of {len(audit.views)} views localize")
            for region in audit.regions()[:5]:
                where = ", ".join(f"{value:.2f}" for value in region["center"])
                print(
                    f"  weak near ({where}): {100 * region['share']:.0f} % at {region['places']} places, {region['cause']}"
                )
        if len(mounts) > 1:
            print(mounts.round(3).to_string(index=False))
        print(f"done in {time.monotonic() - start:.0f} s: {self.out}")
        return audits
