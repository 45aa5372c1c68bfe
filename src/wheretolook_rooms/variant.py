"""Furnished scenes some time later: things stand elsewhere or are gone, lamps are brighter or dimmer, the sun moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook_rooms import large
from wheretolook_rooms.large import Furnished
from wheretolook_rooms.layout import Lamp
from wheretolook_rooms.patches import Patch, move

REACH_M = np.array([0.7, 0.7, 0])  # greatest shift
TURN_RAD = 0.6  # standard deviation
TRIES = 40  # places drawn for a piece, which stays if it fits none
GAP_M = 0.01  # depth to which surfaces may overlap: rugs are thinner


def changed(furnished: Furnished, strength: float, seed: int) -> Furnished:
    """Move a quarter of the movable pieces, remove another, dim or brighten lamps; where there are none, draw a sun.

    A strength below 1 lowers these shares and the factors on the lamps. Patches keep their order, size and pattern, so
    that only the light in the texture differs. Removed ones have no triangles.
    """
    rng = np.random.default_rng([seed, 8])
    lamps: list[Lamp] = []
    for lamp in furnished.lamps:
        if lamp.position[2] < large.SUN_M / 2:
            red, green, blue = np.exp(1.5 * strength * rng.normal()) * np.array(lamp.colour)
            lamps.append(replace(lamp, colour=(red, green, blue)))
    return replace(furnished, patches=_rearranged(furnished.patches, strength, rng), lamps=lamps or large.sun(rng))


def _rearranged(patches: Sequence[Patch], strength: float, rng: np.random.Generator) -> list[Patch]:
    """Patches of which some pieces, runs with the same `Patch.piece`, are moved or without triangles."""
    rearranged: list[Patch] = []
    bounds = _bounds(patches)
    for piece, parts in groupby(patches, key=lambda patch: patch.piece):
        own = [*parts]
        fate = rng.random()
        if piece is not None and fate < strength / 2:
            run = slice(len(rearranged), len(rearranged) + len(own))
            bounds[run] = np.nan  # it touches nothing
            if fate < strength / 4:
                own = [replace(p, mask=np.zeros_like(p.positions[1:, 1:, 0], bool)) for p in own]
            else:
                own = _moved(own, bounds, rng)
                bounds[run] = _bounds(own)
        rearranged += own
    return rearranged


def _moved(piece: list[Patch], others: Float, rng: np.random.Generator) -> list[Patch]:
    """A piece shifted and turned on the flat patch that it stands on, where it overlaps no other bounds (P, 2, 3)."""
    bounds = _bounds(piece)
    low = bounds.min((0, 1))
    high = bounds.max((0, 1))
    middle = (low + high) / 2
    reach = 2 * REACH_M + GAP_M  # turned, a long piece takes more room
    others = others[((low < others[:, 1] + reach) & (others[:, 0] < high + reach)).all(1)]
    flat = others[(np.abs(others[..., 2] - low[2]) < GAP_M).all(1), :, :2]
    for _ in range(TRIES):
        turn = rng.normal(0, TURN_RAD)
        moved = move(move(piece, shift=-middle), angle_rad=turn, shift=middle + rng.uniform(-REACH_M, REACH_M))
        bounds = _bounds(moved)
        stands = (flat[:, 0] < bounds.min((0, 1))[:2]) & (bounds.max((0, 1))[:2] < flat[:, 1])
        overlaps = (bounds[:, None, 0] + GAP_M < others[:, 1]) & (others[:, 0] + GAP_M < bounds[:, None, 1])
        if stands.all(1).any() and not overlaps.all(2).any():
            return moved
    return piece


def _bounds(patches: Sequence[Patch]) -> Float:
    """The least and greatest coordinates of each patch (P, 2, 3)."""
    return np.array([[p.positions.min((0, 1)), p.positions.max((0, 1))] for p in patches])
