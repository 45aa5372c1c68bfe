import json

import numpy as np
import pandas as pd
import pytest

from wheretolook.dataset.layout import SceneFolder
from wheretolook.utils.files import ArtifactCache, cache_key


def test_results_are_loaded_for_the_same_key_only(tmp_path):
    results = {"a.json": [1, 2], "b.npz": {"x": np.arange(3)}, "c.parquet": pd.DataFrame({"y": [1.5]})}
    cache = ArtifactCache(tmp_path / "work", cache_key("settings", 1))
    assert cache.load(*results) is None
    cache.store(results)
    loaded = cache.load(*results)
    assert loaded is not None and loaded["a.json"] == [1, 2]
    np.testing.assert_array_equal(loaded["b.npz"]["x"], np.arange(3))
    pd.testing.assert_frame_equal(loaded["c.parquet"], results["c.parquet"])
    assert ArtifactCache(tmp_path / "work", cache_key("settings", 2)).load(*results) is None
    (tmp_path / "work" / "b.npz").write_bytes(b"damaged")
    assert cache.load("a.json") is not None and cache.load("b.npz") is None


def test_a_stage_invalidates_later_ones(tmp_path):
    scene = SceneFolder(tmp_path, "train")
    for stage in ("scenes", "map", "label"):
        scene.stage_cache(stage, stage).store()
    scene.stage_cache("map", "other").store()
    assert json.loads((tmp_path / "stages.json").read_text()) == {"scenes": "scenes", "map": "other"}
    assert scene.stage_cache("map", "other").is_current(tmp_path)
    assert not scene.stage_cache("map", "other").is_current(tmp_path / "missing")
    scene.stage_cache("scenes").clear()
    assert scene.stage_cache("map").stored_key is None


@pytest.mark.parametrize("content", ["5", "[]", '{"map": 5}', "{", ""])
def test_a_damaged_manifest_counts_as_missing(content, tmp_path):
    cache = SceneFolder(tmp_path, "train").stage_cache("map", "a")
    (tmp_path / "stages.json").write_text(content)
    assert not cache.is_current()
    cache.store()
    assert cache.is_current()
