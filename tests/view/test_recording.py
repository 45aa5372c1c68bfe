"""`wheretolook view --record` and `--film`."""

import pytest
from PIL import Image

from box_scenes import furnished_room
from selection.room import POINTS, WEIGHTS, write_room
from wheretolook.cli import main
from wheretolook.scenes.loading import save_glb
from wheretolook.select.where_to_look import WhereToLook


def test_a_recording_holds_scene_floor_and_paths(tmp_path):
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    sparse = write_room(tmp_path / "sparse")
    look = WhereToLook.from_colmap(sparse, method="visible", occlusion="none", directions=60)
    look.best(POINTS).save(tmp_path / "way.tum")
    recording = tmp_path / "made" / "room.rrd"
    options = ["--map", str(sparse), "--method", "visible", "--weights", str(WEIGHTS)]
    options += ["--path", str(tmp_path / "way.tum"), "--record", str(recording)]
    assert main(["view", *options, "--state", "occlusion=none;height=1.5"]) == 0
    entities = {chunk.entity_path for chunk in RrdReader(recording).stream()}
    names = ("landmarks", "cameras", "floor", "path/way", "path/forward", "path/way/camera", "path/forward/camera")
    assert {f"/world/{name}" for name in names} | {"/score/way", "/score/forward"} <= entities


def test_a_film_shows_both_paths_step_by_step(tmp_path):
    save_glb(furnished_room(), tmp_path / "room.glb")
    sparse = write_room(tmp_path / "sparse", n=200)
    rows = [" ".join(map(str, (0, *point, 0, 0, 0, 1))) for point in POINTS]
    (tmp_path / "way.tum").write_text("\n".join(rows))
    options = ["--map", str(sparse), "--mesh", str(tmp_path / "room.glb"), "--path", str(tmp_path / "way.tum")]
    options += ["--method", "visible", "--state", "occlusion=none", "--film", str(tmp_path / "way.webp")]
    assert main(["view", *options]) == 0
    with Image.open(tmp_path / "way.webp") as film:
        assert film.n_frames == len(POINTS)
