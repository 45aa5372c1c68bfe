"""Write recordings for the Rerun viewer: `wheretolook view --record` and planned paths."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.files import atomic_write
from wheretolook.view import drawing
from wheretolook.view.scenery import CAMERA_COLOR, LANDMARK_COLOR
from wheretolook.view.scores import score_location
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import ViewedMap


class Recording:
    """A Rerun recording; world with z up. `rerun` is the package, whose archetypes `log` takes."""

    def __init__(self, path: Path) -> None:
        import rerun

        self.rerun: Any = rerun
        self.stream: Any = rerun.RecordingStream("wheretolook")
        self.stream.save(str(path))
        self.stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def log(self, entity: str, archetype: Any) -> None:
        """Add an archetype that does not change."""
        self.stream.log(entity, archetype, static=True)

    def log_landmarks(self, points: Float, radius_m: float) -> None:
        """Add landmarks (N, 3) m."""
        self.log("world/landmarks", self.rerun.Points3D(points, radii=radius_m, colors=LANDMARK_COLOR))

    def log_line(self, entity: str, positions: Float) -> None:
        """Add the line through positions (W, 3) m."""
        self.log(entity, self.rerun.LineStrips3D([positions]))

    def log_camera(self, entity: str, pose: Float, camera: Camera, image: NDArray[np.uint8] | None) -> None:
        """Add a camera pose (3, 4) with an image (H, W, 3) of any size; Rerun's cameras have no distortion."""
        rerun = self.rerun
        self.stream.log(entity, rerun.Transform3D(translation=camera_centers(pose), mat3x3=pose[:, :3].T))
        height, width = (camera.height, camera.width) if image is None else image.shape[:2]
        matrix = np.diag([width / camera.width, width / camera.width, 1.0]) @ camera.matrix
        axes = rerun.ViewCoordinates.RDF
        pinhole = rerun.Pinhole(image_from_camera=matrix, width=width, height=height, camera_xyz=axes)
        self.stream.log(entity, pinhole)
        if image is not None:
            self.stream.log(entity, rerun.Image(image).compress(jpeg_quality=85))

    def log_score(self, entity: str, score: float) -> None:
        """Add the score at the current step of the timeline."""
        self.stream.log(entity, self.rerun.Scalars(score))


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Write a recording atomically. Raises StorageError if the file cannot be written."""
    with atomic_write(path) as partial:
        recording = Recording(partial)
        yield recording
        recording.stream.flush()
        recording.stream.disconnect()


def record(viewed: ViewedMap, path: Path, state: ViewState = ViewState()) -> None:
    """Record mesh, landmarks, mapping cameras, floor, the state's location with its best views, and paths.

    Paths are on the timeline "step". Raises StorageError if the file cannot be written, TableError if the state's
    location is outside the map.
    """
    state = viewed.complete(state)
    selector = viewed.selector(state.method, state.occlusion)
    with open_recording(path) as recording:
        rerun = recording.rerun

        def log_view(entity: str, pose: Float) -> None:
            image, _ = viewed.picture(pose, viewed.visible_landmarks(state.method, state.occlusion, pose))
            recording.log_camera(entity, pose, drawing.small_camera(viewed.camera), image)

        if (mesh := viewed.mesh_glb(state.cut)) is not None:
            recording.log("world/mesh", rerun.Asset3D(contents=mesh, media_type="model/gltf-binary"))
        recording.log_landmarks(viewed.landmarks.points, 0.001 * viewed.size_m)
        if viewed.mapping_poses is not None:
            edges = drawing.frusta(viewed.camera, viewed.mapping_poses, viewed.marker_m)
            recording.log("world/cameras", rerun.LineStrips3D(edges, colors=CAMERA_COLOR))
        _log_floor(recording, viewed, state)
        if state.place is not None:
            location = score_location(selector, np.array(state.place), state.n)
            points = location.position + viewed.marker_m * location.directions
            colors = drawing.score_colors(location.scores)
            recording.log("world/place/sphere", rerun.Points3D(points, colors=colors, radii=0.1 * viewed.marker_m))
            edges = drawing.frusta(viewed.camera, location.best.cam_from_world, 2.2 * viewed.marker_m)
            colors = np.repeat(drawing.score_colors(location.best.score), 8, axis=0)
            recording.log("world/place/views", rerun.LineStrips3D(edges, colors=colors))
            log_view("world/place/best", location.best.cam_from_world[0])
        for name, along in viewed.paths.items():
            recording.log_line(f"world/path/{name}", camera_centers(along.cam_from_world))
            scores = selector.scorer.score(along.cam_from_world)
            for step, pose in enumerate(tqdm(along.cam_from_world, desc=name, unit="view")):
                recording.stream.set_time("step", sequence=step)
                log_view(f"world/path/{name}/camera", pose)
                recording.log_score(f"score/{name}", float(scores[step]))
            recording.stream.reset_time()


def _log_floor(recording: Recording, viewed: ViewedMap, state: ViewState) -> None:
    """Score the floor and record it with the best direction at each cell."""
    assert state.height is not None
    rerun = recording.rerun
    floor = viewed.floor(state.method, state.occlusion, state.height)
    with tqdm(total=len(floor.cells), desc="floor", unit="location") as bar:
        while floor.score_next(8):
            bar.update(floor.n_scored - bar.n)
    if not len(floor.cells):
        return
    colors = drawing.score_colors(floor.scores, *viewed.score_range(state.method, floor.scores))
    centers = floor.points
    centers[:, 2] = floor.drawn_m
    half_size = (floor.cell_m / 2, floor.cell_m / 2, 0.005)
    boxes = rerun.Boxes3D(centers=centers, half_sizes=[half_size], colors=colors, fill_mode="solid")
    recording.log("world/floor", boxes)
    arrows = rerun.Arrows3D(origins=floor.points, vectors=floor.axes * 0.8 * floor.cell_m, colors=colors)
    recording.log("world/best", arrows)
