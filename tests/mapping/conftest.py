"""A small textured room, and its free space."""

import pytest

from box_scenes import box_room
from wheretolook.space.free_space import FreeSpace


@pytest.fixture(scope="session")
def room():
    return box_room()


@pytest.fixture(scope="session")
def room_free_space(room):
    return FreeSpace(room)
