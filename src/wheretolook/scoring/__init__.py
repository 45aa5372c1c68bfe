"""Methods that score viewpoints, all with the same interface (`Scorer`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wheretolook.scoring.base import BinnedScorer, Scorer
from wheretolook.scoring.bins import BinsScorer
from wheretolook.scoring.random import RandomScorer
from wheretolook.scoring.registry import SCORERS, make_scorer
from wheretolook.scoring.visible import VisibleScorer

if TYPE_CHECKING:
    from wheretolook.scoring.learned import LearnedScorer, load_scorer

__all__ = [
    "SCORERS",
    "BinnedScorer",
    "BinsScorer",
    "LearnedScorer",
    "RandomScorer",
    "Scorer",
    "VisibleScorer",
    "load_scorer",
    "make_scorer",
]


def __getattr__(name: str) -> Any:
    if name in ("LearnedScorer", "load_scorer"):  # PyTorch takes seconds to load
        from wheretolook.scoring import learned

        return getattr(learned, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
