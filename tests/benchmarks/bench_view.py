"""Measure `wheretolook view`: time to the page, to the first coloured floor and of a turned view, and many clients.

The map has N landmarks in a building of rooms and is scored by the bundled weights with hidden-point removal. Opening
is measured from the start of the command in its own process; printed are the median and range of wall and CPU time.
Clients are websocket connections that join, click, turn the camera and leave like a browser; drawing in a browser is
not measured. Exits with code 1 if a client met an error.

    python tests/benchmarks/bench_view.py --landmarks 100000 --repeat 5
    python tests/benchmarks/bench_view.py --landmarks 100000 --clients 20 --seconds 60
"""

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

import msgspec
import numpy as np
from common import options, write_model

from wheretolook.view.server import Viewer
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import open_map

COMMAND = [sys.executable, "-c", "import sys; from wheretolook.cli import main; sys.exit(main(sys.argv[1:]))"]


def message(kind, **fields):
    """Encode a message as a browser sends it."""
    return bytes(msgspec.msgpack.encode({"type": kind, **fields}))


def camera_message():
    """Encode the message with a browser's camera."""
    pose = {"wxyz": [1, 0, 0, 0], "position": [10, 10, 30], "look_at": [10, 10, 0], "up_direction": [0, 0, 1]}
    return message("ViewerCameraMessage", **pose, fov=1.0, near=0.1, far=99.0, image_height=600, image_width=800)


def connected(port):
    """Return a websocket connection to the viewer on a port."""
    import viser
    from websockets.sync.client import connect

    protocol = f"viser-v{viser.__version__}"
    return connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None)


class Client(threading.Thread):
    """A client that reads all messages for some seconds and clicks at random if asked to."""

    def __init__(self, port, seconds, seed, clicks=True):
        super().__init__(daemon=True)
        self.port = port
        self.seconds = seconds
        self.rng = np.random.default_rng(seed)
        self.received = 0
        self.error = ""
        self.clicks = clicks

    def run(self):
        end = time.monotonic() + self.seconds
        try:
            with connected(self.port) as page:
                page.send(camera_message())
                next_click = time.monotonic() + 1
                while time.monotonic() < end:
                    with contextlib.suppress(TimeoutError):
                        self.received += len(page.recv(timeout=0.2))
                    if self.clicks and time.monotonic() > next_click:
                        x, y = self.rng.uniform(2, 18, 2).tolist()
                        ray = {"ray_origin": [x, y, 30.0], "ray_direction": [0, 0, -1], "screen_pos": [[0.5, 0.5]]}
                        page.send(message("ScenePointerMessage", event_type="click", modifier=None, **ray))
                        page.send(camera_message())
                        next_click = time.monotonic() + self.rng.uniform(1, 3)
        except Exception as error:
            self.error = f"{type(error).__name__}: {error}"


class ErrorCounter(logging.Handler):
    """Counts what the viewer and its libraries log as errors."""

    def __init__(self):
        super().__init__(logging.ERROR)
        self.n = 0

    def emit(self, record):
        self.n += 1


def print_opening(model, repeat):
    """Print how long the command takes to open a model."""
    runs = [opening(model) for _ in range(repeat)]
    for row, what in enumerate(("landmarks on the page", "first coloured floor")):
        parts = []
        for kind, name in enumerate(("wall", "CPU")):
            values = [times[row][kind] for times in runs]
            parts.append(f"{name} {np.median(values):.1f} s ({min(values):.1f} to {max(values):.1f})")
        print(f"{what}: {', '.join(parts)}, {repeat} runs", flush=True)


def opening(model):
    """Return wall and CPU seconds from the start of the command to the landmarks and to the first coloured floor."""
    import zstandard

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    start = time.monotonic()
    command = [*COMMAND, "view", "--map", str(model), "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        times = []
        client = None
        while client is None:
            assert process.poll() is None, "the command has ended"
            time.sleep(0.02)
            with contextlib.suppress(OSError):
                client = connected(port)
        with client:
            client.send(camera_message())
            for wanted in (b"/landmarks", b" locations"):
                content = b""
                while wanted not in content:
                    frame = client.recv(timeout=300)  # two lengths of eight bytes, then zstd
                    content = zstandard.ZstdDecompressor().decompressobj().decompress(frame[16:])
                times.append((time.monotonic() - start, cpu_s(process.pid)))
        return times
    finally:
        process.kill()
        process.wait()


def cpu_s(pid):
    """Return the CPU seconds of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory_mb():
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


def print_turns(session, n):
    """Print how long the score of a view turned by hand takes while the floor fills."""
    session.place.select(np.array([9.0, 9.0, 1.5]))
    while session.location is None:
        time.sleep(0.02)
    time.sleep(2)
    times = []
    for axis in session.location.directions[:: len(session.location.directions) // n][:n]:
        start = time.monotonic()
        session.controls.picture_caption.content = ""
        session.place.turn_to(axis)
        while not session.controls.picture_caption.content and time.monotonic() - start < 10:
            time.sleep(0.001)
        times.append(time.monotonic() - start)
        time.sleep(0.3)
    low, median, high = (1000 * float(value) for value in (min(times), np.median(times), max(times)))
    print(f"score of a view turned by hand: {median:.0f} ms ({low:.0f} to {high:.0f}), {n} turns", flush=True)


def run_clients(viewer, n, seconds):
    """Connect n clients at once, in two rounds; print traffic and memory, and return how many clients failed."""
    failed = 0
    for round_number in (1, 2):
        clients = [Client(viewer.port, seconds / 2, round_number * 1000 + k) for k in range(n)]
        for client in clients:
            client.start()
        peak = 0.0
        while any(client.is_alive() for client in clients):
            peak = max(peak, memory_mb())
            time.sleep(0.5)
        errors = [client.error for client in clients if client.error or not client.received]
        failed += len(errors)
        sent_mb = sum(client.received for client in clients) / 2**20
        print(f"round {round_number}: {n} clients, {sent_mb:.0f} MB sent, at most {peak:.0f} MB of memory; {errors}")
    return failed


def main():
    """Parse the options, measure and print."""
    args = options(__doc__, map=Path, landmarks=100_000, clients=0, seconds=60.0, occlusion="", repeat=1, turns=20)
    errors = ErrorCounter()
    logging.getLogger().addHandler(errors)
    with tempfile.TemporaryDirectory() as folder:
        model = args.map or Path(folder) / "sparse"
        if args.map is None:
            write_model(model, args.landmarks)
        print_opening(model, args.repeat)
        viewer = Viewer(open_map(model), port=0, state=ViewState(occlusion=args.occlusion))
        Client(viewer.port, 1e9, 0, clicks=False).start()
        while not viewer.sessions:
            time.sleep(0.01)
        session = next(iter(viewer.sessions.values()))
        while " locations" not in session.controls.status.content:
            time.sleep(0.05)
        print_turns(session, args.turns)
        failed = run_clients(viewer, args.clients, args.seconds) if args.clients else 0
        viewer.stop()
    print(f"{failed} clients failed, {errors.n} errors logged")
    return int(failed + errors.n > 0)


if __name__ == "__main__":
    sys.exit(main())
