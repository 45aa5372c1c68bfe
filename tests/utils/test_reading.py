"""Files that are damaged, or made to do harm, are refused at once and in little memory."""

import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

import wheretolook
from wheretolook.utils.npz_files import load_npy, load_npz, save_npz
from wheretolook.utils.reading import MAX_TEXT_BYTES, read_json, read_json_object, read_yaml

# Of Python and what is imported: the 200 MB come on top of it.
_MEASURED = """
import resource, sys, time
from pathlib import Path
from wheretolook.utils import npz_files, reading
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
import json, yaml, numpy.lib.format, zipfile
before, start = peak(), time.process_time()
module, name = sys.argv[1].split(".")
try:
    getattr({"reading": reading, "npz_files": npz_files}[module], name)(Path(sys.argv[2]))
except ValueError as error:
    print(time.process_time() - start, peak() - before, str(error)[:200].replace("\\n", " "))
"""


def refused(function: str, path: Path) -> tuple[float, float, str]:
    """Seconds and MB that refusing a file took, and what is said of it."""
    command = [sys.executable, "-c", _MEASURED, function, str(path)]
    sources = {**os.environ, "PYTHONPATH": str(Path(wheretolook.__file__).parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True, env=sources)
    assert done.stdout, "the file was not refused"
    seconds, megabytes, said = done.stdout.split(maxsplit=2)
    return float(seconds), float(megabytes), said


def npz_bomb(path: Path) -> None:
    """A megabyte that unfolds to 200 MB: one array of zeros."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file, file.open("a.npy", "w") as member:
        header = {"descr": "|u1", "fortran_order": False, "shape": (200_000_000,)}
        np.lib.format.write_array_header_1_0(member, header)
        for _ in range(200):
            member.write(bytes(1_000_000))


def npz_that_lies(path: Path) -> None:
    """An array of a header alone that tells of 4 GB."""
    with zipfile.ZipFile(path, "w") as file, file.open("a.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (500_000_000,)}
        np.lib.format.write_array_header_1_0(member, header)


def npy_that_lies(path: Path) -> None:
    header = {"descr": "<f8", "fortran_order": False, "shape": (1_000_000_000_000,)}
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)


def alias_bomb(path: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 30)]
    path.write_text("\n".join(lines))


def long_alias_bomb(path: Path) -> None:
    path.write_text("a: &a " + "x" * 50_000 + "\nb: [" + "*a, " * 10_000 + "]")


@pytest.mark.parametrize(
    ("function", "write", "said"),
    [
        ("npz_files.load_npz", npz_bomb, "would unfold"),
        ("npz_files.load_npz", npz_that_lies, "not a readable NPZ file"),
        ("npz_files.load_npz", lambda path: path.symlink_to("/dev/zero"), "a device"),
        ("npz_files.load_npz", os.mkfifo, "a device"),
        ("npz_files.load_npy", npy_that_lies, "an array of shape"),
        ("reading.read_json", lambda path: path.symlink_to("/dev/zero"), "a device"),
        ("reading.read_json", os.mkfifo, "a device"),
        ("reading.read_json", Path.mkdir, "this is no file"),
        ("reading.read_json", lambda path: path.write_text("[" * 100_000 + "]" * 100_000), "too deeply"),
        ("reading.read_json", lambda path: path.write_text('{"a":' * 100_000 + "1" + "}" * 100_000), "too deeply"),
        ("reading.read_json", lambda path: path.write_text("[" + "[]," * 5_000_000 + "1]"), "values"),
        ("reading.read_json", lambda path: path.write_bytes(bytes(MAX_TEXT_BYTES + 1)), "bytes"),
        ("reading.read_json", lambda path: path.write_text("[" + "9" * 100_000 + "]"), "digits"),
        ("reading.read_json", lambda path: path.write_bytes(b"\xff\xfe{}"), "codec"),
        ("reading.read_yaml", alias_bomb, "aliases written out"),
        ("reading.read_yaml", long_alias_bomb, "aliases written out"),
        ("reading.read_yaml", lambda path: path.write_text("a: &a [*a]"), "no value before it"),
        ("reading.read_yaml", lambda path: path.write_text("[" * 40_000), "too deeply"),
        ("reading.read_yaml", lambda path: path.write_text("a: 2001-99-99"), "month"),
        ("reading.read_yaml", lambda path: path.write_text("? {a: 1}\n: 2"), "unhashable"),
        ("reading.read_yaml", lambda path: path.write_text("!!python/object/apply:os.system ['true']"), "constructor"),
        ("reading.read_yaml", lambda path: path.write_bytes(os.urandom(50_000)), "codec"),
        ("reading.read_yaml", lambda path: path.write_bytes(bytes(50_000)), "allowed"),
        ("reading.read_yaml", lambda path: path.symlink_to("/dev/urandom"), "a device"),
    ],
)
def test_a_bomb_is_refused_within_a_second_and_200_mb(
    function: str, write: Callable[[Path], object], said: str, tmp_path: Path
) -> None:
    path = tmp_path / "file"
    write(path)
    seconds, megabytes, problem = refused(function, path)
    assert said in problem
    assert seconds < 1 and megabytes < 200


@pytest.mark.parametrize("compiled", [True, False])
def test_yaml_makes_plain_values_alone(compiled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not compiled:
        monkeypatch.delattr(yaml, "CSafeLoader", raising=False)  # as where PyYAML was built without it
    path = tmp_path / "file"
    for text in ("!!python/object:fractions.Fraction {}", "!!python/name:os.system", "!!python/tuple [1, 2]"):
        path.write_text(text)
        with pytest.raises(ValueError, match="could not determine a constructor"):
            read_yaml(path)
    path.write_text("a: [1, 2.5, no]")
    assert read_yaml(path) == {"a": [1, 2.5, False]}


def test_good_files_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "file"
    content = {"a": [1, 2.5, None, {"b": "ü"}], "c": list(range(100_000))}
    path.write_text(json.dumps(content))
    assert read_json(path) == read_json_object(path) == content
    text = "base: &base {grid: 1.5, when: 2001-01-02}\nsample: {<<: *base, n: 3}\nlist: [*base, no, ~]\n"
    path.write_text(text)
    assert read_yaml(path) == yaml.safe_load(text)
    arrays = {
        "zeros": np.zeros((1000, 1000), np.uint8),
        "text": np.array("mesh"),
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "empty": np.zeros((0, 3), np.float32),
        "scalar": np.array(5),
    }
    for compress in (False, True):
        save_npz(path, arrays, compress)
        found = load_npz(path)
        assert [*found] == [*arrays]
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype and np.array_equal(found[name], array)
    depth = tmp_path / "depth.npy"
    np.save(depth, arrays["fortran"])
    assert np.array_equal(load_npy(depth), arrays["fortran"])


@pytest.mark.parametrize("content", ["5", "null", "[]", '["a"]', '"text"'])
def test_an_object_is_asked_for(content: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text(content)
    with pytest.raises(ValueError, match="a JSON object is expected"):
        read_json_object(tmp_path / "file")


def test_a_missing_file_is_told_from_a_damaged_one(tmp_path: Path) -> None:
    for read in (read_json, read_yaml):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "file")


def test_pickles_are_not_read(tmp_path: Path) -> None:
    content = io.BytesIO()
    np.savez(content, a=np.array([{}], dtype=object))
    (tmp_path / "file.npz").write_bytes(content.getvalue())
    with pytest.raises(ValueError, match="not a readable NPZ file"):
        load_npz(tmp_path / "file.npz")
