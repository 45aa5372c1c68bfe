"""How long `wheretolook view` takes for one client's turn while another floods it with clicks, turns and nonsense.

    python tests/benchmarks/bench_view_flood.py --landmarks 100000 --messages 100000

Run as a script; nothing fails on time. The map is that of bench_select.py. Told are the milliseconds of a turn before
and during the flood and five seconds after it (median, highest), the process's memory and its threads.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bench_select import SIDE_M, write_model
from benchmarks.bench_view import Counted, camera_message, memory_mb, message
from wheretolook.view.opened import open_map
from wheretolook.view.paths import FORWARD, Played, looking_ahead
from wheretolook.view.server import Viewer
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

MIDDLE = SIDE_M / 2
RAY = {"ray_origin": [MIDDLE, MIDDLE, 30.0], "ray_direction": [0.01, 0, -1], "screen_pos": [[0.5, 0.5]]}
CLICK = message("ScenePointerMessage", event_type="click", modifier=None, **RAY)


def connected(port: int, read: bool = True) -> Any:
    """A client of the viewer, which has told its camera; a thread reads what it is sent."""
    import viser
    from websockets.sync.client import connect

    protocol: Any = f"viser-v{viser.__version__}"
    client = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None)
    if read:
        threading.Thread(target=lambda: [None for _ in client], daemon=True).start()
    client.send(camera_message())
    return client


def nonsense(controls: Any, number: int, rng: np.random.Generator) -> bytes:
    """One of sixteen messages, most of them what a page may send, some what none does."""

    def set_to(handle: Any, **values: Any) -> bytes:
        return message("GuiUpdateMessage", uuid=handle._impl.uuid, updates=values)

    some = float(rng.random())
    lost = {"event_type": "click", "modifier": None, "ray_origin": [float("nan")] * 3, "screen_pos": [[0.5, 0.5]]}
    return (
        CLICK,
        camera_message(),
        set_to(controls.yaw, value=360 * some - 180),
        set_to(controls.threshold, value=some),
        set_to(controls.height, value=1e308 * some),
        set_to(controls.play, value=True),
        set_to(controls.state, value="x" * 1000 + str(some)),
        set_to(controls.shown["landmarks"], value=some < 0.5),
        set_to(controls.n, value=int(20 * some) + 1),
        set_to(controls.method, value=f"no such {some}"),
        message("GuiUpdateMessage", uuid="no such", updates={"value": 1}),
        set_to(controls.yaw, nothing=some),
        message("ScenePointerMessage", ray_direction=[0, 0, some], **lost),
        set_to(controls.save, value=True),
        set_to(controls.occlusion, value="hidden-points" if some < 0.5 else "none"),
        set_to(controls.add, value=True),
    )[number % 16]


def turn_s(client: Any, session: Any, degrees: float) -> float:
    """Seconds until a view turned by hand has its score; at most a minute."""
    told = session.controls.picture_told
    start = time.monotonic()
    told.content = ""
    client.send(message("GuiUpdateMessage", uuid=session.controls.yaw._impl.uuid, updates={"value": degrees}))
    while not told.content and time.monotonic() - start < 60:
        time.sleep(0.002)
    return time.monotonic() - start


def main() -> None:
    """Read the options, measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, default=100_000)
    parser.add_argument("--messages", type=int, default=100_000)
    options = parser.parse_args()
    errors = Counted()
    logging.getLogger().addHandler(errors)
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "sparse"
        write_model(model, options.landmarks)
        path = np.array([[MIDDLE + 0.2 * step, MIDDLE, 1.5] for step in range(4)])
        played = {FORWARD: Played(looking_ahead(np.tile(path, (20, 1))))}
        viewer = Viewer(Shared(open_map(model), played), port=0, state=ViewState(occlusion="none"))
        sessions: list[Any] = []
        clients = []
        for n in (1, 2):
            clients.append(connected(viewer.port))
            while len(viewer.sessions) < n:
                time.sleep(0.01)
            sessions.append(max(viewer.sessions.items())[1])
        (bad, good) = clients
        (flooded, kept) = sessions
        good.send(CLICK)
        while kept.place is None:
            time.sleep(0.05)
        time.sleep(1)
        quiet = [turn_s(good, kept, 10.0 * n - 20) for n in range(5)]
        rng = np.random.default_rng(0)
        sent = threading.Event()
        before = memory_mb()
        threads = threading.active_count()

        def flood() -> None:
            for number in range(options.messages):
                bad.send(nonsense(flooded.controls, number, rng))
            sent.set()

        start = time.monotonic()
        ended = 0.0
        threading.Thread(target=flood, daemon=True).start()
        during: list[float] = []
        memory = [before]
        most = threads
        while not ended or time.monotonic() - ended < 5:
            during.append(turn_s(good, kept, float(37 * len(during) % 300 - 150)))
            memory.append(memory_mb())
            most = max(most, threading.active_count())
            ended = ended or (time.monotonic() if sent.is_set() else 0.0)
            time.sleep(0.3)
        print(f"{options.messages:,} messages in {ended - start:.1f} s; errors logged: {errors.n}")
        for what, times in (("before", quiet), ("during", during)):
            print(
                f"a turn {what}: {1000 * np.median(times):.0f} ms, at most {1000 * max(times):.0f}, {len(times)} turns"
            )
        print(f"memory {before:.0f} MB, at most {max(memory):.0f}, at last {memory[-1]:.0f}; threads {threads}, {most}")
        sys.stdout.flush()
    os._exit(0)  # clients and the viewer still run


if __name__ == "__main__":
    main()
