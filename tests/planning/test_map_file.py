"""Saved viewpoint maps: round trips, foreign readers, and what is damaged."""

from __future__ import annotations

import json
import shutil
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
    "change",
    [
        {"version": 2},
        {"format": "else"},
        {"sizes": {"V": 60, "L": 1, "D": 60, "N": 200}},
        {"sizes": {}},
        {"grid": {"lower": [0, 0, 0], "upper": [0, 1, 1], "shape": [1, 1, 1]}},
        {"grid": {"lower": [0, 0, 0], "upper": [1, 1, 1], "shape": [1, 1, 1]}},
        {"origin": {"scorer": "bins"}},
    ],
)
def test_damaged_descriptions(folder: Path, change: dict[str, object], mmap: bool) -> None:
    path = folder / DESCRIPTION
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(MapFormatError):
        ViewpointMap.load(folder, mmap)


@pytest.mark.parametrize("name", [*(f"{name}.npy" for name in ARRAYS), DESCRIPTION])
@pytest.mark.parametrize("damage", ["missing", "truncated", "flipped"])
def test_damaged_files(folder: Path, name: str, damage: str) -> None:
    path = folder / name
    content = path.read_bytes()
    path.unlink()
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    if damage == "flipped":
        path.write_bytes(content[:-10] + bytes([content[-10] ^ 0x80]) + content[-9:])
    with pytest.raises(MapFormatError):
        ViewpointMap.load(folder)
    if damage != "flipped":
        with pytest.raises(MapFormatError):
            ViewpointMap.load(folder, mmap=True)


@pytest.mark.parametrize(
    "name, content", [("notes.txt", "mine"), (DESCRIPTION, "{"), (DESCRIPTION, '{"format": "else"}')]
)
def test_other_folders_are_neither_read_nor_replaced(
    viewpoint_map: ViewpointMap, tmp_path: Path, name: str, content: str
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(MapFormatError):
        ViewpointMap.load(tmp_path)
    with pytest.raises(MapFormatError):
        viewpoint_map.save(tmp_path)
    assert content_of(tmp_path) == {name: content.encode()}


def test_a_map_with_other_files_is_not_replaced(viewpoint_map: ViewpointMap, folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")
    before = content_of(folder)
    with pytest.raises(MapFormatError):
        viewpoint_map.save(folder)
    assert content_of(folder) == before


def test_rows_must_be_used_once(viewpoint_map: ViewpointMap, folder: Path) -> None:
    rows = viewpoint_map.row_of_voxel.copy()
    first, second = viewpoint_map.voxel_of_row[:2]
    rows[[first, second]] = rows[[second, first]]
    with pytest.raises(ValueError):
        replace(viewpoint_map, row_of_voxel=rows)
    np.save(folder / "row_of_voxel.npy", rows)
    with pytest.raises(MapFormatError):
        ViewpointMap.load(folder, mmap=True)


def test_derived_maps_are_not_saved(viewpoint_map: ViewpointMap, tmp_path: Path) -> None:
    with pytest.raises(MapFormatError):
        shares_below(viewpoint_map).save(tmp_path / "room")
    assert list(tmp_path.iterdir()) == []
