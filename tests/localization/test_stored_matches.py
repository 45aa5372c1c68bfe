"""Matched landmarks stored with the labels: their rows, and that nothing else changes."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from localization.rooms import CAMERA, PLAIN, POSTER, facing, file_bytes, label, times
from wheretolook.dataset.viewpoint_files import MATCH_FIELDS, SCHEMA, read_table, write_table
from wheretolook.dataset.viewpoint_table import TOO_FEW_MATCHES, is_good, poses
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.poses import transform
from wheretolook.localization.config import LocalizerConfig, versions
from wheretolook.localization.labeller import MANIFEST
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.shard import label_rows
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import fingerprint


def test_matched_rows_agree_with_the_labels(room, matched):
    n = len(Landmarks.load(room.landmarks))
    assert list(matched.columns) == [*SCHEMA.names, *MATCH_FIELDS.names]
    for view in matched.itertuples():
        assert view.matched_rows.dtype == view.inlier_rows.dtype == np.int32
        assert len(view.inlier_rows) == view.n_inliers <= len(view.matched_rows)
        assert (len(view.matched_rows) < 4) == (view.status == TOO_FEW_MATCHES)
        assert np.isin(view.inlier_rows, view.matched_rows).all()
        for rows in (view.matched_rows, view.inlier_rows):
            assert (np.diff(rows) > 0).all() and ((rows >= 0) & (rows < n)).all()
    lengths = matched["matched_rows"].map(len)
    assert lengths.min() == 0 and (lengths > matched["n_inliers"]).any() and matched["n_inliers"].max() > 50


def test_labels_are_the_same_with_and_without(views, matched, expected, tmp_path):
    assert file_bytes(matched.drop(columns=MATCH_FIELDS.names), tmp_path / "bare") == expected


@pytest.mark.usefixtures("in_this_process")
def test_shards_with_and_without_matches_have_names_of_their_own(room, tmp_path):
    """Shards without matches have the names and the manifest of versions that could not store matches."""
    table = pd.concat([facing(POSTER, 3, 1.5), facing(PLAIN, 1, 1.1)], ignore_index=True)
    shards = tmp_path / "shards"
    settings = {
        "versions": versions(),
        "localizer": LocalizerConfig().record(),
        "extractor": ExtractorConfig().record(),
        "camera": CAMERA.record(),
        "renderer": "cpu raster",
        "mesh": fingerprint(room.mesh),
        "landmarks": fingerprint(room.landmarks),
        "n_viewpoints": 4,
    }
    label(table, room, shards, shard_size=4)
    (without,) = times(shards)
    assert json.loads((shards / MANIFEST).read_text()) == {**settings, "shards": {without.name: 4}}
    label(table, room, shards, shard_size=4, store_matches=True)
    both = times(shards)
    (stored,) = both.keys() - {without}
    expected = {**settings, "store_matches": True, "shards": {stored.name: 4}}
    assert json.loads((shards / MANIFEST).read_text()) == expected
    label(table, room, shards, shard_size=4)
    assert times(shards) == both


def test_pixels_are_kept_in_the_order_of_the_landmarks(room, views, matched, tmp_path):
    """Inliers of a good view are within RANSAC's limit of their projection at the true pose."""
    landmarks = Landmarks.load(room.landmarks)
    rows = np.flatnonzero(is_good(matched))[:4]
    localizer = Localizer(landmarks, CAMERA)
    renderer = WarpRenderer(load_mesh(room.mesh))
    some = views.iloc[rows].reset_index(drop=True)
    kept = label_rows(some, replace(room.job, store_pixels=True), localizer, renderer)
    write_table(kept, tmp_path / "viewpoints.parquet")
    back = read_table(tmp_path / "viewpoints.parquet", pixels=True)
    assert "matched_pixels" not in read_table(tmp_path / "viewpoints.parquet", matches=True)
    for row, pose in enumerate(poses(some)):
        np.testing.assert_array_equal(back["matched_rows"][row], matched["matched_rows"][rows[row]])
        pixels = back["matched_pixels"][row].reshape(-1, 2)
        assert pixels.dtype == np.float32 and len(pixels) == len(back["matched_rows"][row])
        inlier = np.isin(back["matched_rows"][row], back["inlier_rows"][row])
        at = CAMERA.project(transform(pose, landmarks.points[back["matched_rows"][row][inlier]]))
        assert np.linalg.norm(at - pixels[inlier], axis=1).max() < 10
    with pytest.raises(TableError):
        write_table(matched, tmp_path / "matches.parquet")
        read_table(tmp_path / "matches.parquet", pixels=True)
