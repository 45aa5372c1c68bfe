"""`wheretolook view`: a scene or a map in the browser, with the score of every view."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

from wheretolook.commands.options import CameraOptions, MeshOptions
from wheretolook.dataset.layout import find_scene
from wheretolook.mapping.config import FrameOptions
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError, reject
from wheretolook.utils.package import reports, require


@dataclass(frozen=True, kw_only=True)
class View(CameraOptions, MeshOptions, FrameOptions):
    """View a scene or your own map in the browser, with the score of every view.

    The page shows mesh or landmarks, mapping cameras, and free space at one height, coloured by the best score at each
    location. Click a location for the score of every direction, the best views, the visible landmarks by their
    detection probability, and the camera's image. Rotate the camera by hand, and its score follows.

    Paths (--path): the folder or path.csv that `wheretolook plan` wrote; a scene's folder in results/paths of
    `wheretolook compare-paths`, of which --pair names the start and goal; a TUM trajectory; or a CSV of `wheretolook
    select`. A single path is shown next to the same locations seen by a camera that looks ahead.

    Access: by default only this machine, and no page of another site that is open in its browser; --host 0.0.0.0 serves
    everyone who reaches it. There is no password, and nothing is served but the scene.

    Examples:
      wheretolook view --scene apartment-000
      wheretolook view --map sparse/0 --mesh house.glb
      wheretolook view --map sparse/0 --port 8081
      wheretolook view --scene apartment-000 --path data/demo/apartment-000/path
      wheretolook view --scene apartment-000 --record apartment.rrd    # for the Rerun viewer, nothing is served

    Args:
        scene: a scene of a dataset, as `wheretolook map` leaves it.
        data: folder of the datasets.
        name: dataset of the scene, if several have such a scene.
        map: instead, folder of a COLMAP model.
        path: a path to show.
        pair: which start and goal of compared paths.
        weights: file or folder of weights; by default the scene's own, or the bundled ones.
        method: method that scores at first; by default that of the weights.
        host: address to serve at.
        port: port to serve at.
        state: what to show at first, from the page's field `state`.
        dark: dark at first.
        record: instead of a page, a Rerun recording, FILE.rrd.
        film: instead of a page, the path, method next to method, FILE.webp or .gif.
        device: where to compute: auto, cpu, cuda, or cuda:<index>.
    """

    scene: str | None = None
    data: Path = Path("data")
    name: str = ""
    map: Path | None = None
    path: Path | None = None
    pair: int = 0
    weights: Path | None = None
    method: str = ""
    host: str = "127.0.0.1"
    port: int = 8080
    state: str = ""
    dark: bool = False
    record: Path | None = None
    film: Path | None = None
    device: str = "auto"

    def __post_init__(self) -> None:
        own = (self.mesh, self.camera_id, *vars(self.frame_options()).values())
        of_map = any(value is not None for value in own)
        record = self.record
        film = self.film
        reject(
            ((self.map is None) == (self.scene is None), "what is viewed is given by either --scene or --map", None),
            (
                self.scene is not None and of_map,
                "--mesh, --camera-id and the map's scale and up belong to --map",
                self.scene,
            ),
            (record is not None and film is not None, "give either --record or --film", None),
            (record is not None and record.suffix != ".rrd", "a Rerun recording is a .rrd", str(record)),
            (film is not None and film.suffix not in (".webp", ".gif"), "a film is a .webp or a .gif", str(film)),
            (film is not None and self.path is None, "a film shows a path: give --path", str(film)),
            (
                film is not None and self.scene is None and self.mesh is None,
                "a film of a map needs its --mesh",
                str(film),
            ),
        )
        self.named_camera()

    def run(self) -> None:
        """Serve the page until interrupted; or write a recording or a film."""
        start = time.monotonic()
        if self.scene is not None and self.data.is_dir():
            find_scene(self.data, self.scene, self.name)
        if self.record is not None:
            require("rerun")
        from wheretolook.view.recording import record
        from wheretolook.view.server import Viewer, check_port
        from wheretolook.view.state import ViewState, read_paths
        from wheretolook.view.viewed_map import open_map, open_scene

        if self.record is None and self.film is None:
            check_port(self.host, self.port)
        state = ViewState.parse(self.state)
        if self.method:
            state = replace(state, method=self.method)
        device = usable_device(self.device)
        camera = self.named_camera()
        if self.map is not None:
            viewed = open_map(
                self.map, self.mesh, camera, self.weights, device, self.data, self.frame_options(), self.mesh_up
            )
        else:
            assert self.scene is not None and not isinstance(camera, int)
            viewed = open_scene(self.data, self.scene, self.name, camera, self.weights, device)
        if self.path is not None:
            viewed.paths = read_paths(self.path, self.pair, viewed.frame.world_from_map)
        if state.method and state.method not in viewed.weights.methods:
            fix = f"Use {', '.join(viewed.weights.methods)}."
            raise ConfigError("there is no such method here, or no weights of it", value=state.method, fix=fix)
        summary = f"{viewed.name}: {len(viewed.landmarks):,} landmarks"
        if self.record is not None:
            record(viewed, self.record, state)
            print(f"{summary}, in {time.monotonic() - start:.0f} s: {self.record}")
        elif self.film is not None:
            writers = reports("film")
            if not writers:
                fix = "Install wheretolook with its paper package."
                raise ConfigError("no package that writes films is installed", fix=fix)
            n_frames = writers[0](viewed, self.film, state)
            print(f"{summary}, {n_frames} pictures in {time.monotonic() - start:.0f} s: {self.film}")
        else:
            print(f"{summary}, open after {time.monotonic() - start:.1f} s", flush=True)
            viewer = Viewer(viewed, self.host, self.port, state, self.dark)
            weights = viewed.weights.describe(state.method or viewed.weights.methods[0])
            print(weights or "a method without weights", flush=True)
            print(f"http://{viewer.address}    (Ctrl-C ends it)", flush=True)
            try:
                viewer.wait()
            except KeyboardInterrupt:
                print("ended")
            finally:
                viewer.stop()
