"""One room for all tests of labelling, and its labels from a plain loop in this process."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from localization.rooms import CAMERA, PLAIN, POSTER, facing, file_bytes, map_room
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.shard import label_rows
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """No texture repeats: the room is 5 m long, and so is a texture."""
    return map_room(tmp_path_factory.mktemp("room"), texture_m=5.0)


@pytest.fixture(scope="session")
def views():
    """24 unlabelled viewpoints, of which some localize."""
    parts = facing(POSTER, 12, 1.5), facing(PLAIN, 6, 2.5, seed=1), facing(PLAIN, 6, 1.1)
    return pd.concat(parts, ignore_index=True).assign(viewpoint_id=np.arange(24))


@pytest.fixture(scope="session")
def expected(room, views, tmp_path_factory):
    """The file of their labels that every engine must produce."""
    localizer = Localizer(Landmarks.load(room.landmarks), CAMERA)
    labelled = label_rows(views, room.job, localizer, WarpRenderer(load_mesh(room.mesh)))
    assert labelled["status"].nunique() > 1
    return file_bytes(labelled, tmp_path_factory.mktemp("expected"))


@pytest.fixture(scope="session")
def matched(room, views):
    """Their labels with the landmarks that were matched."""
    localizer = Localizer(Landmarks.load(room.landmarks), CAMERA)
    return label_rows(views, replace(room.job, store_matches=True), localizer, WarpRenderer(load_mesh(room.mesh)))


@pytest.fixture(scope="session")
def expected_matches(matched, tmp_path_factory):
    """The file that every engine must produce when it stores matches."""
    return file_bytes(matched, tmp_path_factory.mktemp("matched"))
