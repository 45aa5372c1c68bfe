"""Check that files of weights exist."""

from __future__ import annotations

from pathlib import Path

from wheretolook.utils.errors import WeightsError
from wheretolook.utils.shipped import or_shipped


def check_there(given: str | Path | None) -> None:
    """Raise a WeightsError if there is no such file or folder of weights: at once, without reading any."""
    if given is not None and not or_shipped(given).exists():
        raise WeightsError("there are no weights", path=or_shipped(given), fix="Correct the path.")
