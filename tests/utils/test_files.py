"""Damaged and crafted files are refused quickly, in little memory; good ones are read as they were written."""

import io
import json
import resource
import struct
import time
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
import yaml

from wheretolook.commands.options import Experiment
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.mapping.depth_images import read_depth
from wheretolook.mapping.photographs import read_photograph
from wheretolook.training.provenance import with_also
from wheretolook.utils.errors import ConfigError, MapError, TableError
from wheretolook.utils.files import (
    MAX_TEXT_BYTES,
    ArtifactCache,
    cache_key,
    image_size,
    load_npy,
    load_npz,
    path_within,
    read_image,
    read_json,
    read_json_object,
    read_parquet,
    read_yaml,
    safe_child,
    save_npz,
    write_json,
)


def npz_bomb(path):
    """A megabyte that expands to 200 MB of zeros."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file, file.open("a.npy", "w") as member:
        header = {"descr": "|u1", "fortran_order": False, "shape": (200_000_000,)}
        np.lib.format.write_array_header_1_0(member, header)
        for _ in range(200):
            member.write(bytes(1_000_000))


def npz_of_wrong_size(path):
    """Only the header of an array of 4 GB."""
    with zipfile.ZipFile(path, "w") as file, file.open("a.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (500_000_000,)}
        np.lib.format.write_array_header_1_0(member, header)


def npy_of_wrong_size(path):
    header = {"descr": "<f8", "fortran_order": False, "shape": (1_000_000_000_000,)}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)


def pickled(path):
    content = io.BytesIO()
    np.savez(content, a=np.array([{}], dtype=object))
    path.write_bytes(content.getvalue())


def text(content):
    return lambda path: path.write_text(content)


INVALID = [
    (load_npz, npz_bomb),
    (load_npz, npz_of_wrong_size),
    (load_npz, pickled),
    (load_npz, lambda path: path.symlink_to("/dev/zero")),
    (load_npy, npy_of_wrong_size),
    (read_json, lambda path: path.symlink_to("/dev/zero")),
    (read_json, Path.mkdir),
    (read_json, text("[" * 100_000 + "]" * 100_000)),
    (read_json, lambda path: path.write_bytes(bytes(MAX_TEXT_BYTES + 1))),
    (read_json_object, text("[]")),
    (read_yaml, text("a: 1\nb: {c: 2, c: 3}")),
    (read_yaml, text("!!python/object/apply:os.system ['true']")),
]


@pytest.mark.parametrize(("read", "write"), INVALID)
def test_invalid_files_are_refused_within_seconds_and_200_mb(read, write, tmp_path):
    path = tmp_path / "file"
    write(path)
    start = time.process_time()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError):
        read(path)
    assert time.process_time() - start < 5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 * 1024


def test_good_files_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "file"
    content = {"a": [1, 2.5, None, {"b": "ü"}], "c": list(range(100_000))}
    path.write_text(json.dumps(content))
    assert read_json(path) == read_json_object(path) == content
    settings = "base: &base {grid: 1.5, when: 2001-01-02}\nsample: {<<: *base, n: 3}\nlist: [*base, no, ~]\n"
    path.write_text(settings)
    assert read_yaml(path) == yaml.safe_load(settings.replace("2001-01-02", "'2001-01-02'"))  # a name, not a date
    arrays = {"text": np.array("mesh"), "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "n": np.array(5)}
    for compress in (False, True):
        save_npz(path, arrays, compress)
        loaded = load_npz(path)
        assert [*loaded] == [*arrays] and [*load_npz(path, ["n"])] == ["n"]
        for name, array in arrays.items():
            assert loaded[name].dtype == array.dtype and np.array_equal(loaded[name], array)
    np.save(tmp_path / "depth.npy", arrays["fortran"])
    assert np.array_equal(load_npy(tmp_path / "depth.npy"), arrays["fortran"])


# Parquet files that would overflow the stack are refused, and those that pandas writes are read.


def _nested(path, depth):
    """No rows of a column nested in so many groups."""

    def number(value):
        parts = []
        while value >= 0x80:
            parts.append(value & 0x7F | 0x80)
            value >>= 7
        return bytes([*parts, value])

    group = b"\x35\x00\x18\x01a\x15\x02\x00"
    column = b"\x15\x02\x25\x00\x18\x01a\x00"
    columns = b"\x19\xfc" + number(depth + 2) + b"\x48\x01r\x15\x02\x00" + group * depth + column
    description = b"\x15\x02" + columns + b"\x16\x00\x19\x0c\x00"
    path.write_bytes(b"PAR1" + description + struct.pack("<I", len(description)) + b"PAR1")


def test_deeply_nested_columns_are_refused(tmp_path):
    path = tmp_path / "a.parquet"
    _nested(path, 100_000)
    before = pa.default_memory_pool().max_memory() or 0
    start = time.process_time()
    with pytest.raises(ValueError):
        read_parquet(path)
    assert time.process_time() - start < 5
    assert (pa.default_memory_pool().max_memory() or 0) < max(before, 2**30)


def test_what_pandas_writes_is_read(rng, tmp_path):
    n = 30_000
    table = pd.DataFrame({"method": rng.choice(["set", "bins"], n), "x": rng.normal(size=n), "n": np.arange(n)})
    table["task"] = table["method"].astype("category")
    table["none"] = None
    table["rows"] = [np.arange(i % 7, dtype=np.int32) for i in range(n)]
    for options in ({}, {"compression": None, "row_group_size": 4000}, {"use_dictionary": False}):
        table.to_parquet(tmp_path / "a.parquet", **options)
        pd.testing.assert_frame_equal(read_parquet(tmp_path / "a.parquet"), pd.read_parquet(tmp_path / "a.parquet"))


# Images that unfold to gigabytes are refused before they do.


def png(path, side):
    """A black square PNG, of which only the first row is there."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    chunks = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(1 + side))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    return path


def test_a_bomb_is_refused_by_its_size(tmp_path):
    path = png(tmp_path / "a.png", 32_000)
    with pytest.raises(MapError):
        read_photograph(path)
    with pytest.raises(ValueError):
        read_depth(path)


def test_images_are_read_as_they_are(tmp_path):
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
    cv2.imwrite(str(tmp_path / "a.png"), depth)
    assert image_size(tmp_path / "a.png") == (4, 3)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", cv2.IMREAD_UNCHANGED), depth)
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:40])
    cv2.imwrite(str(tmp_path / "a.jpg"), np.random.default_rng(0).integers(0, 255, (99, 99), np.uint8))
    whole = (tmp_path / "a.jpg").read_bytes()
    thumbnail = b"\xff\xe1" + (len(whole) + 2).to_bytes(2, "big") + whole
    padded = whole[:2] + thumbnail + b"\xff\xff" + whole[2:] + bytes(100)  # a marker may have fill bytes in front
    (tmp_path / "c.jpg").write_bytes(padded)
    assert read_image(tmp_path / "c.jpg", cv2.IMREAD_UNCHANGED).shape == (99, 99)
    (tmp_path / "d.jpg").write_bytes(padded[:-200])
    for path in (
        tmp_path / "b.png",
        tmp_path / "d.jpg",
        tmp_path,
        Path("/dev/zero"),
        tmp_path / "no.png",
        tmp_path / "n\0.png",
    ):
        with pytest.raises((ValueError, OSError)):
            read_image(path, cv2.IMREAD_UNCHANGED)


# Names from files and options stay within the folder that they are names in.

UP = ["../victim", "/victim", "a/../../victim", "", "a\0b"]


@pytest.mark.parametrize(
    ("inside", "name"),
    [*((safe_child, name) for name in (*UP, "..", ".", "a/b", 5, None)), *((path_within, name) for name in UP)],
)
def test_a_name_stays_within_its_folder(inside, name, tmp_path):
    with pytest.raises(ConfigError):
        inside(tmp_path, name, "a name")
    assert inside(tmp_path, "my scene.1", "a name") == tmp_path / "my scene.1"
    assert path_within(tmp_path, "left/1.jpg", "a photograph") == tmp_path / "left" / "1.jpg"


@pytest.mark.parametrize("name", ["../victim", "/victim"])
def test_datasets_scenes_and_releases_are_in_their_folders(name, tmp_path):
    root = tmp_path / "data" / "set"
    write_json(root / "dataset.json", {"camera": PinholeCamera().record(), "scenes": [{"name": name, "split": "test"}]})
    with pytest.raises(TableError):
        Dataset.load(root)
    with pytest.raises(ConfigError):
        Experiment(data=tmp_path, name=name)
    with pytest.raises(ConfigError):
        with_also(Dataset(root, (SceneFolder(root / "room", "train"),)), [name])


@pytest.mark.parametrize(
    "text", ["", "[1]", "{}", '{"mapped_floor": 3}', '{"mapped_floor": [[1, 2]]}', '{"mapped_floor": ["abcd"]}']
)
def test_a_damaged_description_of_a_scene_is_reported(text, tmp_path):
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(TableError):
        SceneFolder(tmp_path, "test").mapped_floor()


def test_results_are_loaded_for_the_same_key_only(tmp_path):
    results = {"a.json": [1, 2], "b.npz": {"x": np.arange(3)}, "c.parquet": pd.DataFrame({"y": [1.5]})}
    cache = ArtifactCache(tmp_path / "work", cache_key("settings", 1))
    assert cache.load(*results) is None
    cache.store(results)
    loaded = cache.load(*results)
    assert loaded["a.json"] == [1, 2]
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
