"""Damaged and crafted files are refused quickly, in little memory; good ones are read as they were written."""

import io
import json
import resource
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml

from wheretolook.utils.files import MAX_TEXT_BYTES, load_npy, load_npz, read_json, read_json_object, read_yaml, save_npz


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
    (read_yaml, text("a: 2001-99-99")),
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
    assert read_yaml(path) == yaml.safe_load(settings)
    arrays = {"text": np.array("mesh"), "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "n": np.array(5)}
    for compress in (False, True):
        save_npz(path, arrays, compress)
        loaded = load_npz(path)
        assert [*loaded] == [*arrays] and [*load_npz(path, ["n"])] == ["n"]
        for name, array in arrays.items():
            assert loaded[name].dtype == array.dtype and np.array_equal(loaded[name], array)
    np.save(tmp_path / "depth.npy", arrays["fortran"])
    assert np.array_equal(load_npy(tmp_path / "depth.npy"), arrays["fortran"])
