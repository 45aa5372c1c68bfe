"""Saved viewpoint maps: round trips, foreign readers, and what is damaged."""

import json
import os
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from planning.rooms import GRID, TURNED, build, room_landmarks
from wheretolook.planning.scene_map import shares_below
from wheretolook.planning.viewpoint_map import ARRAYS, DESCRIPTION, LAYOUT, ViewpointMap
from wheretolook.utils.errors import MapFormatError


@pytest.fixture(scope="module")
def viewpoint_map():
    return build(room_landmarks(200))


@pytest.fixture
def folder(viewpoint_map, tmp_path):
    viewpoint_map.save(tmp_path / "maps" / "room")
    return tmp_path / "maps" / "room"


def content_of(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("mmap", [False, True])
def test_what_was_saved_comes_back(viewpoint_map, folder, mmap):
    loaded = ViewpointMap.load(folder, mmap)
    for name, (kind, _, _) in ARRAYS.items():
        np.testing.assert_array_equal(getattr(loaded, name), getattr(viewpoint_map, name))
        assert getattr(loaded, name).dtype == np.dtype(kind)
        assert getattr(loaded, name).flags.writeable != mmap
    assert (loaded.grid, loaded.origin) == (viewpoint_map.grid, viewpoint_map.origin)
    assert loaded.world_from_map.record() == viewpoint_map.world_from_map.record()
    loaded.save(folder.with_name("again"))
    assert content_of(folder.with_name("again")) == content_of(folder)


def test_a_map_can_replace_one_whose_files_are_mapped(folder):
    new = build(room_landmarks(205))
    mapped = ViewpointMap.load(folder, mmap=True)
    before = mapped.n_visible.copy()
    new.save(folder)
    assert not np.array_equal(new.n_visible, before)
    np.testing.assert_array_equal(mapped.n_visible, before)  # who has mapped the old files keeps them
    np.testing.assert_array_equal(ViewpointMap.load(folder).n_visible, new.n_visible)


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_the_layouts_example_compiles_and_agrees(viewpoint_map, folder):
    viewpoint_map = viewpoint_map.in_frame(TURNED)
    viewpoint_map.save(folder)
    text = (folder / LAYOUT).read_text().split("IN C++")[1].split("\n\n", 1)[1].split("\n\nLANDMARKS")[0]
    template, body = text.split("  int64_t voxel = 0;", 1)
    about = json.loads((folder / DESCRIPTION).read_text())
    lower, upper, shape = (", ".join(map(str, about["grid"][name])) for name in ("lower", "upper", "shape"))
    scale, turn, shift = about["frame"].values()
    rotation = ", ".join(f"{{{', '.join(map(str, row))}}}" for row in turn)
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
const double lower[] = {{{lower}}}, upper[] = {{{upper}}}, scale = {scale};
const double rotation[][3] = {{{rotation}}}, translation[] = {{{", ".join(map(str, shift))}}};
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
    points = TURNED.inverse.apply(points)
    lines = "\n".join(" ".join(map(repr, point)) for point in points.tolist())
    found = subprocess.run([str(source.with_suffix(""))], input=lines, capture_output=True, text=True, check=True)
    np.testing.assert_array_equal([*map(int, found.stdout.split())], viewpoint_map.best_many(points).direction_id)


@pytest.mark.parametrize(
    "change",
    [
        {"version": 1}, {"format": "else"}, {"sizes": {"V": 60, "L": 1, "D": 60, "N": 200}}, {"sizes": {}},
        {"grid": {"lower": [0, 0, 0], "upper": [1, 1, 1], "shape": [1, 1, 1]}}, {"origin": {"scorer": "bins"}},
    ],
)  # fmt: skip
def test_damaged_descriptions(folder, change):
    path = folder / DESCRIPTION
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    for mmap in (False, True):
        with pytest.raises(MapFormatError):
            ViewpointMap.load(folder, mmap)


def test_a_grid_that_was_moved_is_noticed(folder):
    path = folder / DESCRIPTION
    content = json.loads(path.read_text())
    content["grid"]["lower"][0] += 0.5
    content["grid"]["upper"][0] += 0.5
    path.write_text(json.dumps(content))
    for mmap in (False, True):
        with pytest.raises(MapFormatError, match="changed"):
            ViewpointMap.load(folder, mmap)


@pytest.mark.parametrize("mmap", [False, True])
def test_a_pipe_in_place_of_an_array(folder, mmap):
    (folder / "scores.npy").unlink()
    os.mkfifo(folder / "scores.npy")
    with pytest.raises(MapFormatError):
        ViewpointMap.load(folder, mmap)


@pytest.mark.parametrize("name", ["row_of_voxel.npy", "scores.npy", DESCRIPTION])
def test_damaged_files(folder, name):
    content = (folder / name).read_bytes()
    flipped = content[:-10] + bytes([content[-10] ^ 0x80]) + content[-9:]
    for damaged in (flipped, content[: len(content) // 2], None):
        (folder / name).unlink()
        if damaged is not None:
            (folder / name).write_bytes(damaged)
        with pytest.raises(MapFormatError):
            ViewpointMap.load(folder)


def test_folders_with_other_files_are_not_replaced(viewpoint_map, folder):
    (folder / "notes.txt").write_text("mine")
    (folder.parent / "notes.txt").write_text("mine")
    for other in (folder, folder.parent):
        with pytest.raises(MapFormatError):
            viewpoint_map.save(other)
        assert (other / "notes.txt").read_text() == "mine"


def test_rows_must_be_used_once(viewpoint_map):
    rows = viewpoint_map.row_of_voxel.copy()
    first, second = viewpoint_map.voxel_of_row[:2]
    rows[[first, second]] = rows[[second, first]]
    with pytest.raises(ValueError):
        replace(viewpoint_map, row_of_voxel=rows)


def test_derived_maps_are_not_saved(viewpoint_map, tmp_path):
    with pytest.raises(MapFormatError):
        shares_below(viewpoint_map).save(tmp_path / "room")
    assert list(tmp_path.iterdir()) == []
