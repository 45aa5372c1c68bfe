"""A small map and what selects views of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from selection.room import WEIGHTS, write_room
from wheretolook.select.where_to_look import WhereToLook


@pytest.fixture(scope="session")
def sparse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("room") / "sparse")


@pytest.fixture(scope="session")
def look(sparse: Path) -> WhereToLook:
    return WhereToLook.from_colmap(sparse, weights=WEIGHTS, directions=60, device="cpu")
