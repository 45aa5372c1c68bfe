"""A labelled dataset with stored matches, for the learners."""

import numpy as np
import pytest

from synthetic_dataset import CAMERA, make_dataset
from wheretolook.dataset.viewpoint_files import read_table, write_table
from wheretolook.dataset.viewpoint_table import poses


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """Labels by filled bins; a landmark is detected if its ambiguity is low."""
    made = make_dataset(tmp_path_factory.mktemp("data"))
    for scene in made.scenes:
        table = read_table(scene.table)
        localization_map = scene.localization_map(CAMERA)
        visible = localization_map.landmarks_in_view(poses(table))
        clear = localization_map.landmarks.ambiguity < 0.5
        inliers = [rows[clear[rows]].astype(np.int32) for rows in (visible[view] for view in range(len(table)))]
        others = np.array([len(clear) - 1], dtype=np.int32)  # matched, but perhaps not visible
        matched = [np.union1d(rows, others).astype(np.int32) for rows in inliers]
        write_table(table.assign(matched_rows=matched, inlier_rows=inliers), scene.table)
    return made
