"""Times of `wheretolook view`: to the page, to the first coloured floor, of a view turned by hand; many clients.

Run as a script; nothing fails on time, but it ends with exit code 1 if a client met an error. The map is that of
bench_select.py, of N landmarks in a building of rooms, scored by the weights that ship with hidden-point removal.
Clients are websocket connections that join, click, turn the camera and leave, as a browser does; what a browser then
draws is not measured. Memory is that of the whole process, after a first round that fills what is kept.

    python tests/benchmarks/bench_view.py --landmarks 100000
    python tests/benchmarks/bench_view.py --landmarks 100000 --clients 20 --seconds 60
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import contextlib

from benchmarks.bench_select import write_model
from wheretolook.view.server import Viewer


def message(kind: str, **about: Any) -> bytes:
    """What a browser sends."""
    return bytes(msgspec.msgpack.encode({"type": kind, **about}))


def camera_message() -> bytes:
    """Of its camera when it joins."""
    where = {"wxyz": [1, 0, 0, 0], "position": [10, 10, 30], "look_at": [10, 10, 0], "up_direction": [0, 0, 1]}
    return message("ViewerCameraMessage", **where, fov=1.0, near=0.1, far=99.0, image_height=600, image_width=800)


def memory_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


class Visitor(threading.Thread):
    """A client that clicks around for so many seconds, and reads all that it is sent."""

    def __init__(self, viewer: Viewer, seconds: float, seed: int) -> None:
        super().__init__(daemon=True)
        self.viewer, self.seconds, self.rng = viewer, seconds, np.random.default_rng(seed)
        self.received, self.error = 0, ""

    def run(self) -> None:
        import viser
        from websockets.sync.client import connect

        end = time.monotonic() + self.seconds
        address = f"ws://127.0.0.1:{self.viewer.port}"
        protocol: Any = f"viser-v{viser.__version__}"
        try:
            with connect(address, subprotocols=[protocol], max_size=None) as socket:
                socket.send(camera_message())
                clicks = time.monotonic() + 1
                while time.monotonic() < end:
                    with contextlib.suppress(TimeoutError):
                        self.received += len(socket.recv(timeout=0.2))
                    if time.monotonic() > clicks:
                        x, y = self.rng.uniform(2, 18, 2)
                        ray = {"ray_origin": [x, y, 30.0], "ray_direction": [0, 0, -1], "screen_pos": [[0.5, 0.5]]}
                        socket.send(message("ScenePointerMessage", event_type="click", modifier=None, **ray))
                        socket.send(camera_message())
                        clicks = time.monotonic() + self.rng.uniform(1, 3)
        except Exception as error:
            self.error = f"{type(error).__name__}: {error}"


class Counted(logging.Handler):
    """Counts what the viewer and its libraries log as errors."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.n = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.n += 1


def main() -> int:
    """Read the options, measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, default=100_000)
    parser.add_argument("--clients", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--occlusion", default="")
    options = parser.parse_args()
    errors = Counted()
    logging.getLogger().addHandler(errors)
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "sparse"
        write_model(model, options.landmarks)
        start, start_cpu = time.monotonic(), time.process_time()

        def told(what: str) -> None:
            cpu = time.process_time() - start_cpu
            print(f"{what}: {time.monotonic() - start:.1f} s, CPU {cpu:.1f} s", flush=True)

        from wheretolook.view.opened import open_map
        from wheretolook.view.shared import Shared
        from wheretolook.view.state import ViewState

        shared = Shared(open_map(model))
        viewer = Viewer(shared, port=0, state=ViewState(occlusion=options.occlusion))
        told(f"{options.landmarks:,} landmarks, page served")
        first = Visitor(viewer, 1e9, 0)
        first.start()
        while not viewer.sessions:
            time.sleep(0.01)
        told("first client joined")
        session = next(iter(viewer.sessions.values()))
        while " places" not in session.controls.status.content:
            time.sleep(0.05)
        told("first coloured floor")
        _turns(session)
        failed = _many(viewer, options.clients, options.seconds) if options.clients else 0
        viewer.stop()
    print(f"{failed} clients failed, {errors.n} errors logged")
    return int(failed + errors.n > 0)


def _turns(session: Any, n: int = 20) -> None:
    """Print how long the score of a view turned by hand takes, while the floor fills."""
    session.go_to(np.array([9.0, 9.0, 1.5]))
    while session.place is None:
        time.sleep(0.02)
    time.sleep(2)
    times = []
    for axis in session.place.directions[:: len(session.place.directions) // n][:n]:
        start, session.controls.picture_told.content = time.monotonic(), ""
        session.turn_to(axis)
        while not session.controls.picture_told.content and time.monotonic() - start < 10:
            time.sleep(0.001)
        times.append(time.monotonic() - start)
        time.sleep(0.3)
    low, middle, high = (1000 * float(value) for value in (min(times), np.median(times), max(times)))
    print(f"score of a view turned by hand: {middle:.0f} ms ({low:.0f} to {high:.0f}), {n} turns", flush=True)


def _many(viewer: Viewer, clients: int, seconds: float) -> int:
    """Have many clients look at once, twice: memory of the second time against the first. Returns how many failed."""
    failed = 0
    for round_number in (1, 2):
        visitors = [Visitor(viewer, seconds / 2, round_number * 1000 + k) for k in range(clients)]
        for visitor in visitors:
            visitor.start()
        peak = 0.0
        while any(visitor.is_alive() for visitor in visitors):
            peak = max(peak, memory_mb())
            time.sleep(0.5)
        bad = [visitor.error for visitor in visitors if visitor.error or not visitor.received]
        failed += len(bad)
        sent = sum(visitor.received for visitor in visitors) / 2**20
        told = f"round {round_number}: {clients} clients for {seconds / 2:.0f} s, {sent:.0f} MB sent"
        print(f"{told}, memory at most {peak:.0f} MB, {len(bad)} failed {bad[:1] or ''}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
