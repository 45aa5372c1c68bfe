"""Times of `wheretolook view`: to the page, to the first coloured floor, of a view turned by hand; many clients.

Run as a script; nothing fails on time, but it ends with exit code 1 if a client met an error. The map is that of
bench_select.py, of N landmarks in a building of rooms, scored by the weights that ship with hidden-point removal.
Opening is that of the command in a process of its own, from its start: until a client has the landmarks, and until the
floor has its first colours; median and spread (lowest, highest) of wall time and of the process's CPU time.
Clients are websocket connections that join, click, turn the camera and leave, as a browser does; what a browser then
draws is not measured. Memory is that of the whole process, after a first round that fills what is kept.

    python tests/benchmarks/bench_view.py --landmarks 100000 --repeat 5
    python tests/benchmarks/bench_view.py --landmarks 100000 --clients 20 --seconds 60
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

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
    """A client that clicks around for so many seconds, unless it only looks, and reads all that it is sent."""

    def __init__(self, port: int, seconds: float, seed: int, clicks: bool = True) -> None:
        super().__init__(daemon=True)
        self.port = port
        self.seconds = seconds
        self.rng = np.random.default_rng(seed)
        self.received = 0
        self.error = ""
        self.clicks = clicks

    def run(self) -> None:
        import viser
        from websockets.sync.client import connect

        end = time.monotonic() + self.seconds
        address = f"ws://127.0.0.1:{self.port}"
        protocol: Any = f"viser-v{viser.__version__}"
        try:
            with connect(address, subprotocols=[protocol], max_size=None) as page:
                page.send(camera_message())
                clicks = time.monotonic() + 1
                while time.monotonic() < end:
                    with contextlib.suppress(TimeoutError):
                        self.received += len(page.recv(timeout=0.2))
                    if self.clicks and time.monotonic() > clicks:
                        x, y = self.rng.uniform(2, 18, 2).tolist()
                        ray = {"ray_origin": [x, y, 30.0], "ray_direction": [0, 0, -1], "screen_pos": [[0.5, 0.5]]}
                        page.send(message("ScenePointerMessage", event_type="click", modifier=None, **ray))
                        page.send(camera_message())
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
    parser.add_argument("--map", type=Path, help="instead: a COLMAP model")
    parser.add_argument("--landmarks", type=int, default=100_000)
    parser.add_argument("--clients", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--occlusion", default="")
    parser.add_argument("--repeat", type=int, default=1, help="how often it is opened")
    options = parser.parse_args()
    errors = Counted()
    logging.getLogger().addHandler(errors)
    with tempfile.TemporaryDirectory() as folder:
        model = options.map or Path(folder) / "sparse"
        if options.map is None:
            write_model(model, options.landmarks)
        _openings(model, options.repeat)
        from wheretolook.view.opened import open_map
        from wheretolook.view.shared import Shared
        from wheretolook.view.state import ViewState

        viewer = Viewer(Shared(open_map(model)), port=0, state=ViewState(occlusion=options.occlusion))
        Visitor(viewer.port, 1e9, 0, clicks=False).start()
        while not viewer.sessions:
            time.sleep(0.01)
        session = next(iter(viewer.sessions.values()))
        while " places" not in session.controls.status.content:
            time.sleep(0.05)
        _turns(session)
        failed = _many(viewer, options.clients, options.seconds) if options.clients else 0
        viewer.stop()
    print(f"{failed} clients failed, {errors.n} errors logged")
    return int(failed + errors.n > 0)


def _openings(model: Path, repeat: int) -> None:
    """Print how long the command takes to open a model."""
    found = [_opening(model) for _ in range(repeat)]
    for row, what in enumerate(("landmarks on the page", "first coloured floor")):
        parts = []
        for kind, name in enumerate(("wall", "CPU")):
            values = [times[row][kind] for times in found]
            parts.append(f"{name} {np.median(values):.1f} s ({min(values):.1f} to {max(values):.1f})")
        print(f"{what}: {', '.join(parts)}, {repeat} runs", flush=True)


def _opening(model: Path) -> list[tuple[float, float]]:
    """Wall and CPU time, s, from the start of the command to the landmarks and to the first coloured floor."""
    import viser
    from websockets.sync.client import connect

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    code = "import sys; from wheretolook.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "view", "--map", str(model), "--port", str(port)]
    start = time.monotonic()
    protocol = f"viser-v{viser.__version__}"
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        told: list[tuple[float, float]] = []
        while True:
            assert process.poll() is None, "the command has ended"
            with contextlib.suppress(OSError):
                client = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None)  # type: ignore[list-item]
                break
            time.sleep(0.02)
        with client:
            client.send(camera_message())
            for wanted in (b"/landmarks", b" places"):
                while wanted not in _unpacked(client.recv(timeout=300)):
                    pass
                told.append((time.monotonic() - start, _cpu_s(process.pid)))
        return told
    finally:
        process.kill()
        process.wait()


def _unpacked(frame: Any) -> bytes:
    """The messages of a frame that viser sends: two lengths of eight bytes, zstd, and arrays after it."""
    import zstandard

    return bytes(zstandard.ZstdDecompressor().decompressobj().decompress(frame[16:]))


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _turns(session: Any, n: int = 20) -> None:
    """Print how long the score of a view turned by hand takes, while the floor fills."""
    session.go_to(np.array([9.0, 9.0, 1.5]))
    while session.place is None:
        time.sleep(0.02)
    time.sleep(2)
    times = []
    for axis in session.place.directions[:: len(session.place.directions) // n][:n]:
        start = time.monotonic()
        session.controls.picture_told.content = ""
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
        visitors = [Visitor(viewer.port, seconds / 2, round_number * 1000 + k) for k in range(clients)]
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
