"""A small map and what selects views of it."""

import pytest

from selection.room import WEIGHTS, write_room
from wheretolook.select.where_to_look import WhereToLook


@pytest.fixture(scope="session")
def sparse(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("room") / "sparse")


@pytest.fixture(scope="session")
def look(sparse):
    return WhereToLook.from_colmap(sparse, weights=WEIGHTS, directions=60, device="cpu")
