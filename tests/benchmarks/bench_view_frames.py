"""Pictures a second that a browser draws of `wheretolook view` while its camera goes round.

    python tests/benchmarks/bench_view_frames.py --landmarks 50000 100000 200000
    python tests/benchmarks/bench_view_frames.py --landmarks 200000 --angle gl-egl

Run as a script, with a Chromium on the PATH; nothing fails on time. The map is that of bench_select.py. Landmarks are
all drawn, and then as few as a browser that draws slowly is shown while it turns, in turns; median and spread (lowest,
highest). `--angle` is what Chromium draws with: swiftshader is software, gl-egl and vulkan are a GPU's drivers; which
it then took is told.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.bench_select import SIDE_M, write_model
from view.browser import Browser
from wheretolook.view.opened import open_map
from wheretolook.view.scenery import FEWER, _cloud
from wheretolook.view.server import Viewer
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

RENDERER = """(() => { const gl = document.createElement("canvas").getContext("webgl2");
return gl ? gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL) : "no WebGL"; })()"""


@contextmanager
def going_round(viewer: Viewer) -> Iterator[None]:
    """The cameras of all clients go round the building, sixty steps a second."""
    ended = threading.Event()

    def go() -> None:
        middle = SIDE_M / 2
        step = 0
        while not ended.wait(1 / 60):
            for client in viewer.server.get_clients().values():
                turn = 0.015 * step
                client.camera.position = np.array([middle + 28 * math.cos(turn), middle + 28 * math.sin(turn), 18.0])
                client.camera.look_at = np.array([middle, middle, 1.0])
            step += 1

    thread = threading.Thread(target=go)
    thread.start()
    yield
    ended.set()
    thread.join()


def least(viewer: Viewer) -> int:
    """How many landmarks the viewer's only client is shown while it turns."""
    (session,) = viewer.sessions.values()
    session._thin(session._turning_camera._less)
    clouds = [session.scene.get_handle_by_name(_cloud(n)) for n in range(len(FEWER) + 1)]
    return next(len(cloud.points) for cloud in clouds if cloud is not None and cloud.visible)


def main() -> None:
    """Read the options, measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--landmarks", type=int, nargs="+", default=[200_000])
    parser.add_argument("--angle", default="swiftshader", help="what Chromium draws with")
    parser.add_argument("--size", type=int, nargs=2, default=[1100, 700], help="of the page, pixels")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        browser = Browser(Path(folder) / "profile", tuple(options.size), options.angle)
        for n in options.landmarks:
            model = Path(folder) / f"of-{n}"
            write_model(model, n)
            viewer = Viewer(Shared(open_map(model)), port=0, state=ViewState(method="visible", occlusion="none"))
            tab = browser.open(viewer.url)
            tab.wait(lambda page: "Click a place" in page.text, 60)
            viewer.shared.worker.stop()  # floors would take the cores from the browser
            turning: Any = next(iter(viewer.sessions.values()))._turning_camera
            most = turning._most
            less = 0
            found: dict[bool, list[float]] = {False: [], True: []}
            print(f"{n:,} landmarks, drawn by {tab.evaluate(RENDERER)}", flush=True)
            for _ in range(options.repeat):
                for thinned in (False, True):
                    turning._less, turning._most = (less, most) if thinned else (0, 0)
                    with going_round(viewer):
                        time.sleep(4)  # until as much is shown as the browser can draw
                        found[thinned].append(tab.frames_per_second(3))
                    less = turning._less if thinned else less
                    time.sleep(1.5)
            print(f"  shown while turning, at last: {least(viewer):,}")
            for thinned, values in found.items():
                what = "shown fewer if it is slow" if thinned else "shown all"
                told = f"{np.median(values):.1f} a second ({min(values):.1f} to {max(values):.1f})"
                print(f"  {what}: {told}; errors on the page: {len(tab.errors)}", flush=True)
            viewer.stop()
        browser.close()


if __name__ == "__main__":
    main()
