"""Saved viewpoint maps: round trips, foreign readers, and what is damaged."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planning.rooms import GRID, build, joined, room_landmarks, room_map
from wheretolook.planning.map_building import update_viewpoint_map
from wheretolook.planning.map_file import ARRAYS, DESCRIPTION, LAYOUT
from wheretolook.planning.scene_map import shares_below
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scorers.registry import make_scorer
from wheretolook.utils.errors import MapFormatError


@pytest.fixture(scope="module")
def viewpoint_map() -> ViewpointMap:
    return build(room_landmarks(200))


@pytest.fixture
def folder(viewpoint_map: ViewpointMap, tmp_path: Path) -> Path:
    viewpoint_map.save(tmp_path / "maps" / "room")
    return tmp_path / "maps" / "room"


def content_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("mmap", [False, True])
def test_what_was_saved_comes_back(viewpoint_map: ViewpointMap, folder: Path, mmap: bool) -> None:
    loaded = ViewpointMap.load(folder, mmap)
    for name, (kind, _, _) in ARRAYS.items():
        np.testing.assert_array_equal(getattr(loaded, name), getattr(viewpoint_map, name))
        assert getattr(loaded, name).dtype == np.dtype(kind)
        assert type(getattr(loaded, name)) is np.ndarray
        assert getattr(loaded, name).flags.writeable != mmap
    assert (loaded.grid, loaded.origin) == (viewpoint_map.grid, viewpoint_map.origin)
    point = loaded.locations[3]
    best = loaded.best(point)
    expected = viewpoint_map.best(point)
    assert best is not None and expected is not None
    assert (best.direction_id, best.score, best.n_visible) == (
        expected.direction_id, expected.score, expected.n_visible,
    )  # fmt: skip
    np.testing.assert_array_equal(best.axis, expected.axis)
    loaded.save(folder.with_name("again"))
    assert content_of(folder.with_name("again")) == content_of(folder)
    assert {path.name for path in folder.parent.iterdir()} == {"room", "again"}


def test_a_loaded_map_can_be_updated_and_saved_over_itself(folder: Path) -> None:
    landmarks = joined(room_landmarks(200), room_landmarks(5, seed=4, first_id=900))
    mapped = ViewpointMap.load(folder, mmap=True)
    before = mapped.n_visible.copy()
    update_viewpoint_map(mapped, make_scorer("bins", room_map(landmarks)))[0].save(folder)
    np.testing.assert_array_equal(mapped.n_visible, before)  # who has mapped the old files keeps them
    np.testing.assert_array_equal(ViewpointMap.load(folder).n_visible, build(landmarks).n_visible)


def test_the_layout_is_all_that_a_reader_needs(viewpoint_map: ViewpointMap, folder: Path) -> None:
    """Reads as LAYOUT.txt says, with no help of NumPy's format."""
    about = json.loads((folder / DESCRIPTION).read_text())
    grid = about["grid"]
    sizes = about["sizes"]

    def number(name: str, kind: str, index: int) -> float:
        data = (folder / f"{name}.npy").read_bytes()
        assert data[:8] == b"\x93NUMPY\x01\x00"
        begin = 10 + struct.unpack("<H", data[8:10])[0]
        assert begin % 64 == 0
        return struct.unpack_from("<" + kind, data, begin + index * struct.calcsize("<" + kind))[0]

    for point in np.random.default_rng(0).uniform(GRID.lower, GRID.upper, (40, 3)):
        voxel = 0
        for axis in range(3):
            size = (grid["upper"][axis] - grid["lower"][axis]) / grid["shape"][axis]
            step = min(int((point[axis] - grid["lower"][axis]) // size), grid["shape"][axis] - 1)
            voxel = voxel * grid["shape"][axis] + step
        row = number("row_of_voxel", "i", voxel)
        best = viewpoint_map.best(point)
        assert (row < 0) == (best is None)
        if best is not None:
            direction = number("ranked", "H", int(row) * sizes["D"])
            assert direction == best.direction_id
            assert number("scores", "f", int(row) * sizes["D"] + int(direction)) == best.score
            assert number("n_visible", "I", int(row) * sizes["D"] + int(direction)) == best.n_visible
            assert number("directions", "d", int(direction) * 3 + 1) == best.axis[1]


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_the_layouts_example_compiles_and_agrees(viewpoint_map: ViewpointMap, folder: Path) -> None:
    text = (folder / LAYOUT).read_text().split("IN C++")[1].split("\n\n", 1)[1].split("\n\nTO UPDATE")[0]
    template, body = text.split("  int64_t voxel = 0;", 1)
    about = json.loads((folder / DESCRIPTION).read_text())
    lower, upper, shape = (", ".join(map(str, about["grid"][name])) for name in ("lower", "upper", "shape"))
    program = f"""#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <string>
{template}
std::string file(const std::string& name) {{
  std::ifstream in("{folder}/" + name, std::ios::binary);
  return std::string(std::istreambuf_iterator<char>(in), {{}});
}}
const double lower[] = {{{lower}}}, upper[] = {{{upper}}};
const int64_t shape[] = {{{shape}}}, D = {about["sizes"]["D"]};
const std::string rows = file("row_of_voxel.npy"), ranks = file("ranked.npy");
const char *row_of_voxel_npy = rows.data(), *ranked_npy = ranks.data();
int best(const double* p) {{
  int64_t voxel = 0;{body}
}}
int main() {{
  double p[3];
  while (std::scanf("%lf %lf %lf", p, p + 1, p + 2) == 3) std::printf("%d\\n", best(p));
}}
"""
    source = folder.parent / "query.cpp"
    source.write_text(program)
    subprocess.run(["g++", "-std=c++17", "-o", str(source.with_suffix("")), str(source)], check=True)
    points = np.random.default_rng(0).uniform(np.array(GRID.lower) - 0.3, np.array(GRID.upper) + 0.3, (500, 3))
    lines = "\n".join(" ".join(map(repr, point)) for point in points.tolist())
    found = subprocess.run([str(source.with_suffix(""))], input=lines, capture_output=True, text=True, check=True)
    np.testing.assert_array_equal([*map(int, found.stdout.split())], viewpoint_map.best_many(points).direction_id)


@pytest.mark.parametrize("mmap", [False, True])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, r"viewpoint_map\.json: not a viewpoint map of version 1 \(got .*2"),
        ({"format": "else"}, "not a viewpoint map of version 1"),
        ({"sizes": {"V": 60, "L": 1, "D": 60, "N": 200}}, r"ranked\.npy: not an array of uint16 of shape \(1, 60\)"),
        ({"sizes": {}}, "damaged description"),
        ({"grid": {"lower": [0, 0, 0], "upper": [0, 1, 1], "shape": [1, 1, 1]}}, "damaged description"),
        ({"grid": {"lower": [0, 0, 0], "upper": [1, 1, 1], "shape": [1, 1, 1]}}, "do not fit together"),
        ({"origin": {"scorer": "bins"}}, "damaged description"),
    ],
)
def test_another_version_or_a_damaged_description_is_refused(folder: Path, change, message: str, mmap: bool) -> None:
    path = folder / DESCRIPTION
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(MapFormatError, match=message):
        ViewpointMap.load(folder, mmap)


@pytest.mark.parametrize("mmap", [False, True])
@pytest.mark.parametrize("name", [*(f"{name}.npy" for name in ARRAYS), DESCRIPTION])
@pytest.mark.parametrize("damage", ["missing", "truncated", "empty", "other"])
def test_damaged_files_are_refused(folder: Path, name: str, damage: str, mmap: bool) -> None:
    path = folder / name
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        path.write_bytes({"truncated": content[: len(content) // 2], "empty": b"", "other": b"\xff" * 500}[damage])
    with pytest.raises(MapFormatError, match=name if damage != "missing" else str(folder)):
        ViewpointMap.load(folder, mmap)


def test_a_flipped_bit_is_found(folder: Path) -> None:
    path = folder / "scores.npy"
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(MapFormatError, match=r"scores\.npy: damaged: the checksum"):
        ViewpointMap.load(folder)


def test_what_is_no_map_is_neither_read_nor_replaced(viewpoint_map: ViewpointMap, tmp_path: Path) -> None:
    with pytest.raises(MapFormatError, match="no viewpoint map"):
        ViewpointMap.load(tmp_path / "none")
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(MapFormatError, match="something else is here"):
        viewpoint_map.save(tmp_path)
    with pytest.raises(MapFormatError, match="something else is here"):
        viewpoint_map.save(tmp_path / "notes.txt")
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("content", ['{"mine": 1}', "[]", "null", "{", '{"format": "else"}'])
def test_a_file_of_the_maps_name_does_not_make_a_map(viewpoint_map: ViewpointMap, tmp_path: Path, content: str) -> None:
    (tmp_path / DESCRIPTION).write_text(content)
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(MapFormatError, match="something else is here"):
        viewpoint_map.save(tmp_path)
    assert content_of(tmp_path) == {DESCRIPTION: content.encode(), "thesis.tex": b"mine"}


def test_a_map_with_notes_beside_it_is_not_replaced(viewpoint_map: ViewpointMap, folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")
    before = content_of(folder)
    with pytest.raises(MapFormatError, match=r"notes\.txt: this is no file of the viewpoint map"):
        viewpoint_map.save(folder)
    assert content_of(folder) == before


def test_folders_beside_a_map_are_left_alone(viewpoint_map: ViewpointMap, folder: Path) -> None:
    others = [folder.with_name(name) for name in ("room.before", "room.partial", ".room.mine")]
    for other in others:
        other.mkdir()
        (other / "mine").write_text("mine")
    viewpoint_map.save(folder)
    assert all((other / "mine").read_text() == "mine" for other in others)
    assert {path.name for path in folder.parent.iterdir()} == {"room", *(other.name for other in others)}


@pytest.mark.parametrize("killed", [False, True])
def test_the_old_map_outlives_a_save_that_ends_between_the_two_moves(
    viewpoint_map: ViewpointMap, folder: Path, monkeypatch: pytest.MonkeyPatch, killed: bool
) -> None:
    """An error puts it back; who is killed leaves it where `load` says it is, and the next save leaves it alone."""
    before = content_of(folder)
    rename = Path.rename
    moves = []

    def interrupted(path: Path, target: Path) -> Path:
        moves.append(target)
        if len(moves) == 2 or (killed and len(moves) > 2):
            raise OSError("interrupted")
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", interrupted)
        if killed:
            patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises(OSError, match="interrupted"):
            viewpoint_map.save(folder)
    if not killed:
        assert content_of(folder) == before and len(list(folder.parent.iterdir())) == 1
        return
    with pytest.raises(MapFormatError, match="A save was interrupted: the map from before is") as error:
        ViewpointMap.load(folder)
    old = Path(str(error.value.fix).split(" is ")[1].removesuffix(", move it here."))
    assert content_of(old) == before
    viewpoint_map.save(folder)
    assert content_of(old) == content_of(folder) == before


def test_what_killed_saves_left_is_removed_by_the_next(viewpoint_map: ViewpointMap, folder: Path) -> None:
    """A half-written new map always, the old one once there is a new one."""
    unfinished = folder.with_name(".room.abcdefgh")
    superseded = folder.with_name(".room.ijklmnop")
    (unfinished / "new").mkdir(parents=True)
    (superseded / "old").mkdir(parents=True)
    for path in (unfinished / "new" / "scores.npy", superseded / "old" / "scores.npy"):
        path.write_bytes(b"half")
    (folder.with_name(".room.settings")).write_text("mine")
    viewpoint_map.save(folder)
    assert {path.name for path in folder.parent.iterdir()} == {"room", ".room.settings"}


def test_rows_that_are_not_each_of_one_voxel_are_refused(viewpoint_map: ViewpointMap, folder: Path) -> None:
    rows = viewpoint_map.row_of_voxel.copy()
    first, second = viewpoint_map.voxel_of_row[:2]
    for changed in ({first: 1, second: 0}, {first: 1}, {first: -2}):
        wrong = rows.copy()
        for voxel, row in changed.items():
            wrong[voxel] = row
        with pytest.raises(ValueError, match="row_of_voxel"):
            replace(viewpoint_map, row_of_voxel=wrong)
        np.save(folder / "row_of_voxel.npy", wrong)
        with pytest.raises(MapFormatError, match="do not fit together: row_of_voxel"):
            ViewpointMap.load(folder, mmap=True)


def test_derived_maps_are_not_saved(viewpoint_map: ViewpointMap, tmp_path: Path) -> None:
    with pytest.raises(MapFormatError, match=r"derived from another.*scores replaced by ranks"):
        shares_below(viewpoint_map).save(tmp_path / "room")
    assert list(tmp_path.iterdir()) == []
