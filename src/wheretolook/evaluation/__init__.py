"""How well methods choose viewpoints: localization score, oracle, intervals, and the logged runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wheretolook.evaluation.config import EvaluateConfig

if TYPE_CHECKING:
    from wheretolook.evaluation.results import latest_scores
    from wheretolook.evaluation.run import evaluate

__all__ = ["EvaluateConfig", "evaluate", "latest_scores"]


def __getattr__(name: str) -> Any:
    if name in ("evaluate", "latest_scores"):  # loads scikit-learn and Matplotlib
        from wheretolook.evaluation import results, run

        return getattr(run if name == "evaluate" else results, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
