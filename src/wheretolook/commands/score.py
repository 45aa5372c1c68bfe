"""`wheretolook score`: score poses of your own."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.commands.selector_options import SelectorOptions, finish
from wheretolook.utils.errors import MapWarning

if TYPE_CHECKING:
    from wheretolook.select.views import SelectedViews


BODY_PITCH_DEG = 60.0  # of all poses, from which on they seem to be of a robot whose z is up


@dataclass(frozen=True, kw_only=True)
class Score(SelectorOptions):
    """Score poses of your own in a COLMAP model; needs no dataset.

    Poses (--poses), in the frame of the map; camera x right, y down, z forward:
      CSV          x, y, z, qw, qx, qy, qz or TUM's tx, ty, tz, qx, qy, qz, qw: camera-to-world; COLMAP's
                   qw, qx, qy, qz, tx, ty, tz: world-to-camera; and a name: id, waypoint, name, t or timestamp
      TUM          "t x y z qx qy qz qw", camera-to-world
      COLMAP       images.txt, world-to-camera

    The file of results has the columns and formats of `wheretolook select`, a row for each pose.

    Examples:
      wheretolook score --map sparse/0 --poses trajectory.tum --out scores.csv
      wheretolook score --map sparse/0 --poses sparse/0/images.txt --mesh house.glb --out scores.csv

    Args:
        poses: file of the poses.
        skip: leave out poses outside the map or inside geometry.
    """

    poses: Path
    skip: bool = False

    def __post_init__(self) -> None:
        from wheretolook.select.views import check_format

        super().__post_init__()
        check_format(self.out, self.format, 1)

    def run(self) -> SelectedViews:
        """Score the poses, write them to `out` and print a summary."""
        from wheretolook.io.poses import read_poses

        names, cam_from_world = read_poses(self.poses)
        selector = self.open_map()
        views = selector.report(cam_from_world, names, self.skip)
        if (views.pitch_deg > BODY_PITCH_DEG).all():
            text = (
                "every camera looks up; are these a robot's orientations, x ahead and z up? Give its camera's, z ahead"
            )
            warnings.warn(f"{self.poses}: {text} and y down", MapWarning, stacklevel=2)
        finish(self, selector, views, len(names), "poses")
        print(f"scores: {self.out}")
        return views
