"""The viewer's server and sessions, without a browser."""

import threading
import time
from dataclasses import replace
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import urlopen

import numpy as np
import pytest

pytest.importorskip("viser")

import msgspec
from markdown_it import MarkdownIt

from box_scenes import furnished_room
from selection.room import POINTS, WEIGHTS, write_room
from waiting import wait_until
from wheretolook.cli import main
from wheretolook.geometry.poses import camera_centers
from wheretolook.geometry.views import Views
from wheretolook.planning.config import FORWARD
from wheretolook.scenes.loading import save_glb
from wheretolook.utils.errors import ConfigError, InUseError, MapWarning
from wheretolook.view.drawing import escape_markdown
from wheretolook.view.server import Viewer, check_port
from wheretolook.view.state import ViewState, looking_ahead
from wheretolook.view.viewed_map import open_map

STATE = ViewState(method="visible", occlusion="none")


@pytest.fixture(scope="module")
def sparse(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("view") / "sparse")


@pytest.fixture
def viewer(sparse):
    viewed = open_map(sparse, weights=WEIGHTS)
    viewed.paths = {FORWARD: Views(looking_ahead(np.tile(POINTS, (20, 1))))}
    made = Viewer(viewed, port=0, state=STATE)
    yield made
    made.stop()


def connect(viewer, path="", headers=None):
    import viser
    from websockets.sync import client

    address = f"ws://127.0.0.1:{viewer.port}/{path}"
    protocols = [f"viser-v{viser.__version__}"]
    return client.connect(address, subprotocols=protocols, max_size=None, close_timeout=1, additional_headers=headers)


def message(kind, **fields):
    return msgspec.msgpack.encode({"type": kind, **fields})


def camera(x=0.0):
    """What a browser sends when it joins and when its camera moves."""
    pose = {"wxyz": [1, 0, 0, 0], "position": [x, 0, 9], "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
    return message("ViewerCameraMessage", **pose, fov=1.0, near=0.1, far=99.0, image_height=600, image_width=800)


def click(z=-1.0):
    ray = {"ray_origin": [1.5, 2.0, 9.0], "ray_direction": [0.01, 0, z]}
    return message("ScenePointerMessage", event_type="click", screen_pos=[[0.5, 0.5]], modifier=None, **ray)


def setting(session, control, value, field="value"):
    handle = getattr(session.controls, control)
    return message("GuiUpdateMessage", uuid=handle._impl.uuid, updates={field: value})


def join(viewer, client):
    """Wait for the session of the newest client, which can be clicked."""
    n = len(viewer.sessions)
    client.send(camera())
    wait_until(lambda: len(viewer.sessions) > n, 60)
    session = viewer.sessions[max(viewer.sessions)]
    wait_until(lambda: session.client.scene._scene_pointer_cb, 60)
    return session


def test_clients_have_their_own_state_and_survive_invalid_messages(viewer):
    with connect(viewer) as first, connect(viewer, "?view=n=2;place=1.5,2,1.5;method=bins") as second:
        one = join(viewer, first)
        other = join(viewer, second)
        wait_until(lambda: other.location is not None)
        assert (one.state.method, other.state.method) == ("visible", "bins")
        assert len(other.location.best) == 2 and one.location is None
        for invalid in (b"\xff\x00", "text", message("NoSuchMessage")):
            with connect(viewer) as bad:
                bad.send(camera())
                bad.send(invalid)
                time.sleep(0.1)
        first.send(click(float("nan")))
        first.send(click())
        wait_until(lambda: one.location is not None)
        np.testing.assert_allclose(one.location.position[:2], (1.5, 2), atol=0.1)


def test_a_flood_of_messages_does_not_delay_other_clients(viewer):
    with connect(viewer) as bad, connect(viewer) as good:
        session = join(viewer, bad)
        n_threads = threading.active_count()
        for turn in range(200):
            values = {"yaw": turn % 180, "threshold": turn / 200, "height": 1e308}
            values |= {"inside": bool(turn % 2), "leave": True, "method": f"none {turn}"}
            for sent in (click(), camera(), setting(session, "yaw", 1.0, "no such field")):
                bad.send(sent)
            for name, value in values.items():
                bad.send(setting(session, name, value))
        joined = join(viewer, good)
        good.send(click())
        caption = joined.controls.picture_caption
        wait_until(lambda: joined.location is not None and bool(caption.content), 60)
        caption.content = ""
        good.send(setting(joined, "yaw", 77.0))
        wait_until(lambda: "landmarks in view" in caption.content, 10)
        assert threading.active_count() < n_threads + 12


def test_invalid_values_of_controls_are_reported_and_restored(viewer):
    with connect(viewer) as client:
        session = join(viewer, client)
        controls = session.controls
        errors = []
        session.show_error = errors.append
        values = {"method": "../../weights", "occlusion": "x", "n": 10**9, "height": float("nan")}
        values |= {"threshold": float("inf"), "cut": -1e300, "limits": "no", "yaw": 1e9}
        for name, value in values.items():
            client.send(setting(session, name, value))
        wait_until(lambda: len(errors) >= len(values))
        assert {type(error) for error in errors} == {ConfigError}
        assert controls.method.value == "visible" and 1 <= controls.n.value <= 20
        assert session.state.n == 5 and np.isfinite(session.state.height)


def test_only_the_page_is_served(viewer):
    with urlopen(f"http://127.0.0.1:{viewer.port}") as answer:
        assert b"<html" in answer.read(2000).lower()
    for path in ("/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/sparse/images.bin"):
        with pytest.raises(HTTPError):
            urlopen(f"http://127.0.0.1:{viewer.port}{path}")
    assert viewer.server.request_share_url() is None and viewer.server.get_host() == "127.0.0.1"


def test_pages_of_other_sites_are_rejected(viewer):
    for origin in ("http://localhost:8080", "http://[::1]:8080", "https://mine.example"):
        assert viewer._is_allowed({"Origin": origin, "X-Forwarded-Host": "mine.example"})
    for origin in ("https://evil.example", "https://localhost.evil.example", "null", "http://["):
        assert not viewer._is_allowed({"Origin": origin, "X-Forwarded-Host": ""})
    with connect(viewer, headers={"Origin": "https://evil.example"}) as client:
        client.send(camera())
        time.sleep(0.3)
        assert not viewer.sessions
    viewer.host = "0.0.0.0"
    assert viewer._is_allowed({"Origin": "https://evil.example"})


def test_text_of_files_and_links_is_escaped(viewer):
    hostile = "<iframe srcdoc='<script>steal()</script>'> ![x](http://evil/x) **b** `c` &lt;a&gt; [l](javascript:x)"
    shown = MarkdownIt().render(escape_markdown(hostile))
    assert shown.count("<") == 2 and "<p>&lt;iframe" in shown  # the paragraph only
    with connect(viewer, "?view=" + quote("what=<img src=http://evil>")) as client:
        session = join(viewer, client)
        wait_until(lambda: "\\<img src" in session.controls.summary.content)


def test_a_mesh_in_another_frame_is_reported_in_terminal_and_page(sparse, tmp_path):
    room = furnished_room()
    save_glb(room, tmp_path / "room.glb")
    assert not open_map(sparse, tmp_path / "room.glb", weights=WEIGHTS).warnings
    save_glb(replace(room, vertices=room.vertices + np.float32([1, 1, 1])), tmp_path / "room.glb")
    with pytest.warns(MapWarning):
        viewed = open_map(sparse, tmp_path / "room.glb", weights=WEIGHTS)
    assert any("from the mesh" in text for text in viewed.warnings)


def test_paths_are_drawn_with_their_cameras(viewer):
    positions = camera_centers(viewer.viewed.paths[FORWARD].cam_from_world)
    with connect(viewer) as client:
        lines = join(viewer, client).scene.get_handle_by_name(f"/paths/{FORWARD}").points
    np.testing.assert_allclose(lines[: len(positions) - 1, 1], positions[1:], atol=1e-6)
    assert len(lines) == len(positions) - 1 + 8 * len(positions)  # edges of a frustum


def test_a_port_in_use(viewer):
    with pytest.raises(InUseError):
        check_port("127.0.0.1", viewer.port)


@pytest.mark.parametrize(
    "options",
    [
        "", "--map nowhere", "--map nowhere --scene x", "--scene x --data nowhere", "--scene x --mesh x.glb",
        "--map nowhere --state n=0", "--map nowhere --port 70000", "--map nowhere --path nowhere.csv",
        "--map nowhere --film way.mp4", "--map nowhere --record x.txt",
    ],
)  # fmt: skip
def test_invalid_options(options):
    assert main(["view", *options.split(), *([] if "--port" in options else ["--port", "0"])]) == 2


def test_lines_far_from_the_origin_keep_their_shape(viewer):
    """In single precision, coordinates of UTM are coarse to half a metre."""
    far = np.array([431_207.125, 5_412_345.5, 312.0])
    lines = far + np.random.default_rng(0).uniform(-1, 1, (20, 2, 3))
    with connect(viewer) as client:
        session = join(viewer, client)
        session.add_lines("/far", lines, (0, 0, 0), 1.0)
        handle = session.scene.get_handle_by_name("/far")
    np.testing.assert_allclose(np.float32(handle.points) + np.asarray(handle.position), lines, atol=1e-4)
