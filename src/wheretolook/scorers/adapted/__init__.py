"""The set network, adapted to one scene by views that were localized there."""

from __future__ import annotations

from wheretolook.scorers.registry import Method, imported

METHODS = (
    Method(
        name="adapted",
        about="The set network, calibrated to one scene.",
        build=imported("wheretolook.scorers.adapted.score:adapted_scorer"),
        weights="adapted",
        probability=True,
        only_if_named=True,
    ),
)
