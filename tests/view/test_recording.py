"""`wheretolook view --record` and `--film`: a recording for Rerun with everything in it, and a moving picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from box_scenes import furnished_room
from selection.room import POINTS, WEIGHTS, write_room
from wheretolook.cli import main
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.scenes.loading import save_glb
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.view.opened import open_map
from wheretolook.view.paths import FORWARD, Played, looking_ahead
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState
from wheretolook_paper.commands.film import film


def test_a_recording_holds_scene_floor_place_and_paths(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    sparse = write_room(tmp_path / "sparse")
    WhereToLook.from_colmap(sparse, method="visible", occlusion="none", directions=60).best(POINTS).save(
        tmp_path / "way.tum"
    )
    state = "occlusion=none;n=2;height=1.5;place=1.5,2,1.5"
    given = [
        "--map",
        str(sparse),
        "--method",
        "visible",
        "--weights",
        str(WEIGHTS),
        "--path",
        str(tmp_path / "way.tum"),
    ]
    assert main(["view", *given, "--state", state, "--record", str(tmp_path / "made" / "room.rrd")]) == 0
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "made" / "room.rrd").stream()}
    wanted = {"landmarks", "cameras", "floor", "best", "place/sphere", "place/views", "place/best", "path/way"}
    wanted |= {"path/forward", "path/way/camera", "path/forward/camera"}
    assert {f"/world/{name}" for name in wanted} | {"/score/way", "/score/forward"} <= paths


def test_a_film_shows_both_cameras_step_by_step(tmp_path: Path) -> None:
    mesh = tmp_path / "room.glb"
    save_glb(furnished_room(), mesh)
    opened = open_map(write_room(tmp_path / "sparse", n=200), mesh, weights=WEIGHTS)
    told = poses_looking_along(POINTS, np.tile((-1.0, -0.5, 0.0), (4, 1)))
    paths = {FORWARD: Played(looking_ahead(POINTS)), "set": Played(told)}
    n = film(Shared(opened, paths), tmp_path / "way.webp", ViewState(method="visible", occlusion="none", threshold=5))
    with Image.open(tmp_path / "way.webp") as picture:
        assert n == len(POINTS) == picture.n_frames and picture.size == (760, 430)
        first = np.asarray(picture.convert("RGB")).astype(int)
        picture.seek(2)
        assert (np.abs(np.asarray(picture.convert("RGB")).astype(int) - first).max(axis=2) > 60).mean() > 0.02


@pytest.mark.parametrize("given", [["--film", "way.mp4"], ["--record", "x.txt"], ["--film", "x.webp"]])
def test_files_of_other_kinds_and_films_without_a_path_are_refused(given: list[str]) -> None:
    assert main(["view", "--map", "nowhere", *given]) == 2
