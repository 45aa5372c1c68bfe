"""What the viewer reads, refuses and serves, without a browser."""

from __future__ import annotations

import json
import socket
import threading
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pycolmap
import pytest

pytest.importorskip("viser")

from box_scenes import furnished_room
from selection.room import POINTS, WEIGHTS, write_room
from wheretolook.cli import main
from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.scenes.loading import save_glb
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import ConfigError, InUseError, MapWarning, TableError
from wheretolook.view import drawing
from wheretolook.view.checks import check_port
from wheretolook.view.controls import check_value, value_of
from wheretolook.view.opened import open_map
from wheretolook.view.paths import FORWARD, Played, looking_ahead, read_paths
from wheretolook.view.saving import views_at, views_file
from wheretolook.view.server import Viewer, where_clicked
from wheretolook.view.session import Session
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState
from wheretolook.view.texts import plain
from wheretolook.view.turning import Turning
from wheretolook.view.worker import LATER, NOW, SOON, Worker

STATE = ViewState("visible", "none", 3, 0.25, 1.4, 2.0, (1.0, 2.0, 1.5), -30.0, 5.0, (0.0, 0.0, 9.0), (1.0, 1.0, 0.0))


@pytest.fixture(scope="module")
def sparse(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("view") / "sparse")


@pytest.fixture
def viewer(sparse: Path) -> Iterator[Viewer]:
    made = Viewer(Shared(open_map(sparse, weights=WEIGHTS)), port=0, state=ViewState(method="visible"))
    yield made
    made.stop()


def test_a_state_survives_text_and_link() -> None:
    assert ViewState.parse(STATE.text()) == STATE and ViewState.parse("") == ViewState() and ViewState().text() == ""
    link = STATE.link("localhost:8080")
    assert link.startswith("http://localhost:8080/?websocket=ws://localhost:8080/?view=")
    assert not {*link.partition("?")[2]} & {*' &#%+"<>'}  # the browser takes it as it is
    assert ViewState.of_path("/" + link.rpartition("/")[2]) == STATE
    far = replace(STATE, place=(431207.125, 5412345.5, 312.046), eye=(431207.0, 5412345.5, 312.05), cut=1234.05)
    assert ViewState.parse(far.text()) == far
    assert ViewState.of_path("/") is None and ViewState.of_path("/?other=1") is None


@pytest.mark.parametrize(
    "text",
    [
        *("n=0", "n=x", "height=nan", "place=1,2", "place=1,2,inf", "what=1", "n", "x" * 3000),
        "eye=1,2,3;target=1,2,3",  # looks nowhere
    ],
)
def test_nonsense_is_no_state(text: str) -> None:
    with pytest.raises(ConfigError):
        ViewState.parse(text)


def test_a_port_in_use_is_refused_with_another_one(sparse: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InUseError, match="--port"):
            check_port("127.0.0.1", port)
        assert main(["view", "--map", str(sparse), "--port", str(port)]) == 2
    assert f"{port}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "given, told",
    [
        ([], "--scene or by --map"),
        (["--map", "nowhere"], "nowhere"),
        (["--map", "nowhere", "--scene", "x"], "--scene or by --map"),
        (["--scene", "x", "--data", "nowhere"], "no such folder of datasets"),
        (["--scene", "x", "--mesh", "x.glb"], "belong to --map"),
        (["--map", "nowhere", "--state", "n=0"], "no state"),
        (["--map", "nowhere", "--port", "70000"], "65535"),
        (["--map", "nowhere", "--host", "no.such.host.invalid"], "no such host"),
        (["--map", "nowhere", "--path", "nowhere.csv"], "no such path"),
        (["--map", "nowhere", "--images", "nowhere"], "no such folder of photographs"),
    ],
)
def test_bad_options_are_refused_plainly(given: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    port = [] if "--port" in given else ["--port", "0"]
    assert main(["view", *given, *port]) == 2
    said = capsys.readouterr().err
    assert told in said and "Traceback" not in said


def test_a_scene_half_made_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    about = {"camera": {"width": 64, "height": 48, "focal_px": 32.0}, "scenes": [{"name": "half", "split": "test"}]}
    (tmp_path / "set" / "half").mkdir(parents=True)
    (tmp_path / "set" / "dataset.json").write_text(json.dumps(about))
    assert main(["view", "--scene", "half", "--data", str(tmp_path), "--port", "0"]) == 2
    assert "half made" in capsys.readouterr().err


def test_paths_are_read_from_every_file_that_holds_poses(tmp_path: Path, sparse: Path) -> None:
    look = WhereToLook.from_colmap(sparse, method="visible", occlusion="none", directions=60)
    views = look.best(POINTS)
    wanted = views.cam_from_world
    views.save(tmp_path / "views.csv")
    views.save(tmp_path / "views.tum")
    pd.DataFrame({"score": 0.5, **pose_columns(wanted)}).to_csv(tmp_path / "path.csv", index=False)
    for name, method in (("views.csv", "views"), ("views.tum", "views"), ("path.csv", "planned")):
        found = read_paths(tmp_path / name)
        assert [*found] == [FORWARD, method] and found[method].localized is None
        np.testing.assert_allclose(found[method].cam_from_world, wanted, atol=1e-5)
        np.testing.assert_allclose(camera_centers(found[FORWARD].cam_from_world), POINTS, atol=1e-5)
    assert [*read_paths(tmp_path)] == [FORWARD, "planned"]
    rows = [
        pd.DataFrame({**pose_columns(wanted), "method": method, "pair": pair, "task": "planned", "waypoint": range(4)})
        for pair in (0, 1)
        for method in ("forward", "set")
    ]
    table = pd.concat(rows).assign(status="localized", error_m=0.01, error_deg=0.1)
    table.loc[table["method"] == "forward", "error_m"] = 1.0
    scene = tmp_path / "paths" / "compared"
    scene.mkdir(parents=True)
    table.drop(columns=["status", "error_m", "error_deg"]).to_parquet(scene / "views.parquet")
    found = read_paths(scene, 1)
    assert [*found] == ["forward", "set"] and found["set"].localized is None
    table.assign(scene="compared").to_parquet(scene.parent / "views.parquet")
    found = read_paths(scene, 1)
    assert [*found] == ["forward", "set"] and found["set"].localized is not None and found["set"].localized.all()
    assert found["forward"].localized is not None and not found["forward"].localized.any()
    with pytest.raises(TableError, match="pair"):
        read_paths(scene, 7)
    lost = table["method"].eq("set") & table["pair"].eq(1)  # a method found no path: the views along the given one
    both = pd.concat([table[~lost], table[table["pair"] == 1].assign(task="given")])
    both.assign(scene="compared").to_parquet(scene.parent / "views.parquet")
    np.testing.assert_allclose(read_paths(scene, 1)["set"].cam_from_world, wanted, atol=1e-9)


def test_looking_ahead_follows_the_path_and_keeps_on_where_it_stands() -> None:
    at = np.array([(0.0, 0, 1), (0, 0, 1), (1, 0, 1), (1, 2, 1.5), (1, 2, 1.5)])
    axes = looking_ahead(at)[:, 2, :3]
    np.testing.assert_allclose(axes, [(1, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 0), (0, 1, 0)], atol=1e-12)


@pytest.mark.parametrize("text", ["", "1 2 3\n", "x,y\n1,2\n", "\0\0", "0 1 2 3 0 0 0 0\n" * 2])
def test_what_is_no_path_is_refused(tmp_path: Path, text: str) -> None:
    for name in ("path.csv", "path.tum"):
        (tmp_path / name).write_text(text)
        with pytest.raises(TableError):
            read_paths(tmp_path / name)


def test_a_click_meets_the_floor() -> None:
    np.testing.assert_allclose(where_clicked((0, 0, 5), (1, 0, -2), 1.0), (2, 0, 1))  # type: ignore[arg-type]
    assert where_clicked((0, 0, 5), (1, 0, 2), 1.0) is None and where_clicked((0, 0, 5), (1, 0, 0), 1.0) is None
    assert where_clicked((0, 0, float("nan")), (1, 0, -1), 1.0) is None and where_clicked((), (), 1.0) is None


@pytest.mark.parametrize("format", ["CSV", "JSON", "TUM trajectory", "COLMAP images.txt", "benchmark poses"])
def test_waypoints_are_saved_as_select_writes_them(sparse: Path, tmp_path: Path, format: str) -> None:
    look = WhereToLook.from_colmap(sparse, method="visible", occlusion="none", directions=60)
    kind, ending = {
        "CSV": ("csv", ".csv"),
        "JSON": ("json", ".json"),
        "TUM trajectory": ("tum", ".tum"),
        "COLMAP images.txt": ("colmap", ".txt"),
        "benchmark poses": ("benchmark", ".txt"),
    }[format]
    n = 1 if kind in ("tum", "benchmark") else 3
    look.best(POINTS, n).save(tmp_path / f"wanted{ending}", kind)
    assert views_file([*views_at(look, POINTS, 3, format)], format) == (tmp_path / f"wanted{ending}").read_bytes()


def test_urgent_work_goes_first_and_what_fails_stops_nothing_else() -> None:
    worker = Worker()
    done = []
    failed = []
    wait = threading.Event()

    def steps(name: str, n: int) -> Iterator[None]:
        wait.wait(10)
        for step in range(n):
            done.append((name, step))
            yield

    def fails() -> Iterator[None]:
        yield
        raise ValueError("nonsense")

    worker.submit(1, "floor", LATER, steps("first", 3), failed.append)
    worker.submit(2, "floor", LATER, steps("second", 2), failed.append)
    worker.submit(3, "floor", LATER, fails(), failed.append)
    worker.submit(1, "old", NOW, steps("old", 5), failed.append)
    worker.submit(1, "old", NOW, steps("new", 2), failed.append)
    worker.submit(4, "floor", LATER, steps("gone", 5), failed.append)
    worker.forget(4)
    wait.set()
    end = time.monotonic() + 10
    while len(done) < 7 or not failed:
        assert time.monotonic() < end
        time.sleep(0.01)
    worker.stop()
    names = [name for name, _ in done]
    assert names.count("first") == 3 and names.count("second") == 2 and "gone" not in names
    assert names.index("new") <= 1 and [str(error) for error in failed] == ["nonsense"]


def test_floors_wait_while_a_view_is_turned_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wheretolook.view.worker.PATIENCE_S", 1.0)
    worker = Worker()  # type: ignore[var-annotated]
    when = []

    def step(name: str) -> Iterator[None]:
        when.append((name, time.monotonic()))
        yield

    begun = time.monotonic()
    while time.monotonic() < begun + 1.8:
        worker.submit(1, "view", NOW, step("turned"), pytest.fail)
        worker.submit(1, "floor", LATER, step("floor"), pytest.fail)
        time.sleep(0.1)
    worker.stop()
    floors = [at for name, at in when if name == "floor"]
    assert len(floors) == 2 and len(when) - len(floors) > 5
    assert np.diff(floors)[0] >= 1.0


def test_pictures_show_scores_in_the_projects_colors() -> None:
    raster = np.array([[0.0, np.nan], [1.0, 0.4]])
    image = drawing.floor_image(raster, 0, 1, 0.5)
    cell = drawing.CELL_PX
    assert image.shape == (2 * cell, 2 * cell, 4) and image[0, cell, 3] == 0 and image[0, 0, 3] > 200
    np.testing.assert_array_equal(image[cell, 0, :3], drawing.score_colors(np.array(1.0)))
    assert (drawing.score_colors(np.array([np.nan])) == drawing.UNKNOWN).all()
    glb = drawing.sphere_glb(np.vstack([np.eye(3), -np.eye(3)]), np.linspace(0, 1, 6), 0, 1, 0.2)
    assert glb[:4] == b"glTF"
    pose = poses_looking_along((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert pose.shape == (3, 4)


def _client(viewer: Viewer, view: str = "", headers=None):  # type: ignore[no-untyped-def]
    import viser
    from websockets.sync.client import connect

    address = f"ws://127.0.0.1:{viewer.port}/{view}"
    protocols = [f"viser-v{viser.__version__}"]
    return connect(address, subprotocols=protocols, max_size=None, close_timeout=1, additional_headers=headers)  # type: ignore[arg-type]


def camera_message(x: float = 0.0) -> bytes:
    """What a browser says of its camera when it joins, and where it then goes."""
    import msgspec

    about = {"wxyz": [1, 0, 0, 0], "position": [x, 0, 9], "fov": 1.0, "near": 0.1, "far": 99.0}
    about |= {"look_at": [0, 0, 0], "up_direction": [0, 0, 1], "image_height": 600, "image_width": 800}
    return msgspec.msgpack.encode({"type": "ViewerCameraMessage", **about})


def _until(what, seconds: float = 20.0) -> None:  # type: ignore[no-untyped-def]
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_each_client_has_its_own_state_and_nonsense_hurts_nobody(viewer: Viewer) -> None:
    import msgspec

    with _client(viewer) as first, _client(viewer, "?view=n=2;place=1.5,2,1.5;method=bins") as second:
        first.send(camera_message())
        second.send(camera_message())
        _until(lambda: len(viewer.sessions) == 2 and any(s.place is not None for s in viewer.sessions.values()))
        by_method = {session.state.method: session for session in viewer.sessions.values()}
        assert {*by_method} == {"visible", "bins"}
        place = by_method["bins"].place
        assert len(place.best) == 2 and by_method["visible"].place is None
        np.testing.assert_allclose(place.position, (1.5, 2, 1.5))
        for nonsense in (b"\xff\x00nonsense", "text", msgspec.msgpack.encode({"type": "NoSuchMessage"})):
            with _client(viewer) as bad:
                bad.send(camera_message())
                bad.send(nonsense)
                time.sleep(0.1)
        click = {"type": "ScenePointerMessage", "event_type": "click", "screen_pos": [[0.5, 0.5]], "modifier": None}
        rays = {"ray_origin": [1.5, 2.0, 9.0], "ray_direction": [float("nan"), 0, -1]}
        first.send(msgspec.msgpack.encode({**click, **rays}))
        first.send(msgspec.msgpack.encode({**click, **rays, "ray_direction": [0, 0, -1]}))
        _until(lambda: by_method["visible"].place is not None)
        np.testing.assert_allclose(by_method["visible"].place.position[:2], (1.5, 2))
        _until(lambda: len(viewer.sessions) == 2)


def test_a_flood_of_messages_holds_nobody_else_up(sparse: Path) -> None:
    """One client sends thousands of messages, good ones, wrong ones and ones that wait; another's score still comes."""
    import msgspec

    paths = {FORWARD: Played(looking_ahead(np.tile(POINTS, (20, 1))))}
    shared = Shared(open_map(sparse, weights=WEIGHTS), paths)
    flooded = Viewer(shared, port=0, state=ViewState(method="visible", occlusion="none"))
    try:
        with _client(flooded) as bad, _client(flooded) as good:
            bad.send(camera_message())
            _until(lambda: len(flooded.sessions) == 1)
            (session,) = flooded.sessions.values()

            def set_to(which: Session, name: str, value: object, what: str = "value") -> bytes:
                about = {"uuid": getattr(which.controls, name)._impl.uuid, "updates": {what: value}}
                return msgspec.msgpack.encode({"type": "GuiUpdateMessage", **about})

            ray = {"ray_origin": [1.5, 2.0, 9.0], "ray_direction": [0.01, 0, -1]}
            click = {"type": "ScenePointerMessage", "event_type": "click", "screen_pos": [[0.5, 0.5]], "modifier": None}
            before = threading.active_count()
            times = 400
            for turn in range(times):
                good_and_wrong = {
                    "yaw": turn % 180, "step": turn % 80 + 1, "threshold": turn / times, "play": True, "add": True,
                    "save": True, "photo": True, "method": f"no such {turn}", "height": 1e308, "state": "x" * 1000,
                }  # fmt: skip
                bad.send(msgspec.msgpack.encode({**click, **ray}))
                bad.send(camera_message())
                for name, value in good_and_wrong.items():
                    bad.send(set_to(session, name, value))
                bad.send(set_to(session, "yaw", 1.0, "no such thing"))
            good.send(camera_message())
            _until(lambda: len(flooded.sessions) == 2, 60)
            joined = max(flooded.sessions.items())[1]
            _until(lambda: joined.client.scene._scene_pointer_cb, 60)  # it can be clicked in
            good.send(msgspec.msgpack.encode({**click, **ray}))
            _until(lambda: joined.place is not None and bool(joined.controls.picture_told.content), 60)
            joined.controls.picture_told.content = ""
            good.send(set_to(joined, "yaw", 77.0))
            _until(lambda: "landmarks in view" in joined.controls.picture_told.content, 10)
            playing = [thread for thread in threading.enumerate() if "_play" in thread.name]
            assert len(playing) <= 1 and threading.active_count() < before + 12
    finally:
        flooded.stop()


@pytest.mark.parametrize(
    ("pause_s", "step_m", "least"),
    [(0.12, 0.4, 20), (0.12, 0.1, 400), (0.05, 0.4, 400), (0.005, 0.4, 400)],  # a slow hand is no slow browser
)
def test_a_browser_that_draws_slowly_is_shown_fewer_and_fewer_landmarks_while_it_turns(
    pause_s: float, step_m: float, least: int, viewer: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wheretolook.view.scenery.FEWER", (500, 100, 20))  # of 400 there are
    with _client(viewer) as client:
        client.send(camera_message())
        _until(lambda: viewer.sessions)
        (session,) = viewer.sessions.values()
        _until(lambda: session.client.scene._scene_pointer_cb)

        def sizes(seen_alone: bool) -> list[int]:
            clouds = [session.scene.get_handle_by_name(f"/landmarks{name}") for name in ("", "-1", "-2", "-3")]
            return [len(cloud.points) for cloud in clouds if cloud is not None and (cloud.visible or not seen_alone)]

        def turn(times: int) -> list[int]:
            seen = []
            for step in range(times):
                client.send(camera_message(step_m * (step + 1)))
                time.sleep(0.02 * (pause_s > 0.1))
                client.send(camera_message(step_m * (step + 1)))  # a browser tells it once more
                time.sleep(pause_s - 0.02 * (pause_s > 0.1))
                seen += sizes(True)
            return seen

        assert sizes(False) == [400, 100, 20] and sizes(True) == [400]
        steps = [400, 100, 20]
        assert list(dict.fromkeys([400, *turn(30)])) == steps[: steps.index(least) + 1]
        _until(lambda: sizes(True) == [400], 2)  # it stands still
        if least < 400:  # and begins again, with what it was shown last
            assert turn(3)[-1] == 20
            session.draw_scene()  # such as cut elsewhere
            assert sizes(False) == [400, 100, 20] and sizes(True) == [20]
            _until(lambda: sizes(True) == [400], 2)


def test_all_is_shown_at_last_however_long_less_took_to_be_shown() -> None:
    shown = []

    def show(less: int) -> None:
        time.sleep(0.5 if less else 0.0)  # longer than a camera must stand still
        shown.append(less)

    turning = Turning(show, 1)
    for step in range(5):
        turning.moved((float(step), 0.0, 9.0), (0.0, 0.0, 0.0))
        time.sleep(0.1)
    _until(lambda: len(shown) > 1 and turning._timer is None)
    time.sleep(0.2)
    assert shown[0] == 1 and shown[-1] == 0


def test_the_slow_picture_that_a_turn_begins_with_does_not_end_it() -> None:
    shown: list[int] = []
    turning = Turning(shown.append, 1)
    for step in range(5):
        turning.moved((float(step), 0.0, 9.0), (0.0, 0.0, 0.0))
        time.sleep(0.2)
    _until(lambda: shown == [1, 0], 2)
    for step in range(2):
        turning.moved((5.0 + step, 0.0, 9.0), (0.0, 0.0, 0.0))
        time.sleep(0.4 if step == 0 else 0.0)
    assert shown == [1, 0, 1]
    _until(lambda: shown == [1, 0, 1, 0], 2)


def test_turns_without_end_do_not_keep_places_and_floors_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wheretolook.view.worker.PATIENCE_S", 0.5)
    monkeypatch.setattr("wheretolook.view.worker.CLICK_PATIENCE_S", 0.2)
    worker = Worker()  # type: ignore[var-annotated]
    done = []

    def step(name: str) -> Iterator[None]:
        done.append(name)
        yield

    def turns() -> Iterator[None]:
        while True:  # the next is there before this one is done
            time.sleep(0.01)
            yield

    worker.submit(1, "view", NOW, turns(), pytest.fail)
    for name in ("first", "second"):  # the first of a kind need not wait
        worker.submit(2, "place", SOON, step(f"{name} place"), pytest.fail)
        worker.submit(2, "floor", LATER, step(f"{name} floor"), pytest.fail)
        _until(lambda name=name: {f"{name} place", f"{name} floor"} <= {*done}, 10)  # type: ignore[misc]
    worker.stop()


def test_nothing_but_the_page_is_served_and_no_client_opens_it_to_the_world(viewer: Viewer) -> None:
    from urllib.error import HTTPError
    from urllib.request import urlopen

    with urlopen(viewer.url.replace("localhost", "127.0.0.1")) as answer:
        assert b"<html" in answer.read(2000).lower()
    for path in ("/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/sparse/images.bin"):
        with pytest.raises(HTTPError):
            urlopen(f"http://127.0.0.1:{viewer.port}{path}")
    assert viewer.server.request_share_url() is None
    assert viewer.server.get_host() == "127.0.0.1"


def test_names_of_files_and_links_are_shown_letter_by_letter(viewer: Viewer) -> None:
    from markdown_it import MarkdownIt

    hostile = "<iframe srcdoc='<script>steal()</script>'> ![x](http://evil/x) **b** `c` &lt;a&gt; [l](javascript:x)"
    shown = MarkdownIt().render(plain(hostile))
    assert shown.count("<") == 2 and "<p>&lt;iframe" in shown and "![x](http://evil/x)" in shown  # the paragraph alone
    with _client(viewer, "?view=" + quote("what=<img src=http://evil>")) as client:
        client.send(camera_message())
        _until(lambda: any("no state" in s.controls.told.content for s in viewer.sessions.values()))
        (session,) = viewer.sessions.values()
        assert "\\<img src" in session.controls.told.content


@pytest.mark.parametrize(
    ("origin", "forwarded", "may"),
    [
        ("http://localhost:8080", None, True),
        ("http://[::1]:8080", None, True),
        ("https://evil.example", None, False),
        ("https://localhost.evil.example", None, False),
        ("null", None, False),
        ("http://[", None, False),
        ("https://mine.example", "mine.example", True),
    ],
)
def test_pages_of_other_sites_see_nothing(origin: str, forwarded: str | None, may: bool, viewer: Viewer) -> None:
    headers = {"Origin": origin} | ({"X-Forwarded-Host": forwarded} if forwarded else {})
    with _client(viewer, headers=headers) as client, _client(viewer) as other:
        client.send(camera_message())
        time.sleep(0.2)
        other.send(camera_message())
        _until(lambda: len(viewer.sessions) >= 1 + may)
        time.sleep(0.1)
        assert len(viewer.sessions) == 1 + may
    viewer.host = "0.0.0.0"
    assert viewer._may_look(headers)


def test_a_map_that_lies_is_told_on_the_page(sparse: Path, viewer: Viewer, tmp_path: Path) -> None:
    """Not in the terminal alone, which nobody reads who has the page before them."""
    model = pycolmap.Reconstruction(sparse)
    turn = pycolmap.Rotation3d(np.array([np.sin(np.pi / 4), 0, 0, np.cos(np.pi / 4)]))  # a quarter, about x: y is up
    model.transform(pycolmap.Sim3d(100.0, turn, np.zeros(3)))
    model.write(tmp_path)
    with pytest.warns(MapWarning):
        opened = open_map(tmp_path, weights=WEIGHTS)
    lying = Viewer(Shared(opened), port=0, state=ViewState(method="visible", occlusion="none"))
    try:
        for shown, doubted in ((viewer, False), (lying, True)):
            with _client(shown) as client:
                client.send(camera_message())
                _until(lambda shown=shown: shown.sessions)  # type: ignore[misc]
                doubts = next(iter(shown.sessions.values())).controls.doubts
                assert doubts.visible == doubted and bool(doubts.content) == doubted
        said = doubts.content.replace("\\", "")
        assert "seems not to be in metres" in said and "The cameras lie on their side" in said
        assert str(tmp_path) not in said
    finally:
        lying.stop()


@pytest.mark.parametrize(("scale", "up_m", "doubted"), [(1.0, 0.0, False), (1.0, 40.0, True), (0.01, 0.0, True)])
def test_a_mesh_in_another_frame_or_unit_is_told_in_terminal_and_page(
    scale: float, up_m: float, doubted: bool, sparse: Path, tmp_path: Path
) -> None:
    room = furnished_room()
    vertices = (scale * room.vertices + np.float32([0, 0, up_m])).astype(np.float32)
    save_glb(replace(room, vertices=vertices), tmp_path / "room.glb")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        opened = open_map(sparse, tmp_path / "room.glb", weights=WEIGHTS)
    said = [str(one.message) for one in told if one.category is MapWarning]
    assert [f"{tmp_path / 'room.glb'}: half of the landmarks are" in text for text in said] == [True] * doubted
    shown = Viewer(Shared(opened), port=0, state=ViewState(method="visible", occlusion="none"))
    try:
        with _client(shown) as client:
            client.send(camera_message())
            _until(lambda: shown.sessions)
            doubts = next(iter(shown.sessions.values())).controls.doubts
        assert doubts.visible == doubted and ("from the mesh" in doubts.content) == doubted
        assert str(tmp_path) not in doubts.content
    finally:
        shown.stop()


def test_values_that_no_control_offers_are_told_and_put_back(viewer: Viewer) -> None:
    import msgspec

    with _client(viewer) as client:
        client.send(camera_message())
        _until(lambda: viewer.sessions)
        (session,) = viewer.sessions.values()
        controls = session.controls
        told = []
        session.failed = told.append  # type: ignore[method-assign]
        nonsense = {"method": "../../weights", "occlusion": "x", "n": 10**9, "height": float("nan"), "format": "/x"}
        nonsense |= {"threshold": float("inf"), "cut": -1e300, "limits": "no", "yaw": 1e9}
        for name, value in nonsense.items():
            message = {
                "type": "GuiUpdateMessage",
                "uuid": getattr(controls, name)._impl.uuid,
                "updates": {"value": value},
            }
            client.send(msgspec.msgpack.encode(message))
        _until(lambda: len(told) >= len(nonsense) - 1)  # the format is looked at when it is needed
        assert {type(error) for error in told} == {ConfigError}, told
        assert controls.method.value in viewer.shared.opened.methods and 1 <= controls.n.value <= 20
        assert session.state.method == "visible" and session.state.n == 5 and np.isfinite(session.state.height)
        with pytest.raises(ConfigError, match="no such value"):
            check_value(controls.format, "CSV")
        assert controls.format.value == "CSV"
        # until it has been put back, others take what was known
        controls.height._impl.value = float("nan")
        assert value_of(controls.height, 1.5) == 1.5 and value_of(controls.n, 7) == controls.n.value
        session._slid()
        assert np.isfinite(session.state.height)


def test_the_ground_of_the_dark_is_no_darker_than_low_scores(viewer: Viewer) -> None:
    with _client(viewer) as client:
        client.send(camera_message())
        _until(lambda: viewer.sessions)
        (session,) = viewer.sessions.values()
        grounds: list[object] = []
        session.client.scene.set_background_image = lambda image, **_: grounds.append(image)
        session.theme(True)
        session.theme(False)
        assert grounds[0].min() > drawing.score_colors(np.zeros(1)).mean() and grounds[1] is None  # type: ignore[attr-defined]


def test_paths_that_are_too_large_or_no_poses_are_refused(tmp_path: Path) -> None:
    poses = np.tile(np.eye(3, 4), (4, 1, 1))
    row = {"method": "set", "pair": 0, "task": "planned", "waypoint": range(4)}
    for name, table in {
        "far": pd.DataFrame({**pose_columns(poses), **row, "tx": 1e300}),
        "no turn": pd.DataFrame({**pose_columns(poses), **row, "qw": np.nan}),
        "many": pd.concat([pd.DataFrame({**pose_columns(poses), **row, "method": f"m{i}"}) for i in range(30)]),
        "bomb": None,
    }.items():
        path = tmp_path / f"{name}.parquet"
        if table is None:  # 160 MB of nothing in a few kilobytes
            values = pa.array(np.zeros(20_000_000, dtype=np.int64))
            pq.write_table(pa.table({"pair": values}), path, compression="zstd")
            assert path.stat().st_size < 400_000
        else:
            table.to_parquet(path)
        with pytest.raises(TableError, match=r"finite poses|at most 20 methods|would unfold|Found zero norm"):
            read_paths(path)
    (tmp_path / "long.tum").write_bytes(b"0 0 0 0 0 0 0 1\n" * 1_100_000)
    with pytest.raises(TableError, match="bytes"):
        read_paths(tmp_path / "long.tum")
