"""The set network, adapted to one scene by views that were localized there."""

from __future__ import annotations

from wheretolook.scorers.registry import Method, MethodStyle, imported

METHODS = (
    Method(
        position=120,
        name="adapted",
        about="The set network, calibrated to one scene.",
        style=MethodStyle("adapted to the scene", "#882255", "P", "-"),
        group="learned",
        build=imported("wheretolook.scorers.adapted.score:adapted_scorer"),
        weights="adapted",
        probability=True,
        only_if_named=True,
        one_place=True,
    ),
)
