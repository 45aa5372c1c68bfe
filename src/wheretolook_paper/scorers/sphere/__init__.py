"""A network that scores all directions at a location at once, in the manner of ActLoc."""

from __future__ import annotations

from wheretolook.scorers.method import Method, MethodStyle, imported, network_scorer
from wheretolook_paper.scorers.sphere.config import SphereConfig

METHODS = (
    Method(
        position=110,
        name="sphere",
        about="Like ActLoc: one pass over a location's landmarks and the mapping cameras scores 6 x 18 directions.",
        style=MethodStyle("whole sphere (manner of ActLoc)", "#6699CC", "H", (0, (3, 1))),
        group="learned",
        build=network_scorer(
            "wheretolook_paper.scorers.sphere.score:SphereScorer",
            "wheretolook_paper.scorers.sphere.network:SphereNetwork",
            "sphere",
        ),
        weights="sphere",
        probability=True,
        one_camera=True,
        learn=imported("wheretolook_paper.scorers.sphere.learn:learn_sphere"),
        config=SphereConfig,
        folder="sphere",
    ),
)
