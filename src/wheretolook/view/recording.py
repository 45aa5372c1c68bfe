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
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import Floor, ViewedMap


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
        self.log("world/landmarks", self.rerun.Points3D(points, radii=radius_m, colors=drawing.LANDMARK_COLOR))

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


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Write a recording atomically. Raises StorageError if the file cannot be written."""
    with atomic_write(path) as partial:
        recording = Recording(partial)
        yield recording
        recording.stream.flush()
        recording.stream.disconnect()


def record(viewed: ViewedMap, path: Path, state: ViewState = ViewState()) -> None:
    """Record mesh, landmarks, mapping cameras, floor, and paths.

    Paths are on the timeline "step". Raises StorageError if the file cannot be written.
    """
    state = viewed.complete(state)
    scorer = viewed.selector(state.method, state.occlusion).scorer
    camera = drawing.small_camera(viewed.camera)
    with open_recording(path) as recording:
        rerun = recording.rerun
        if (mesh := viewed.mesh_glb(state.cut)) is not None:
            recording.log("world/mesh", rerun.Asset3D(contents=mesh, media_type="model/gltf-binary"))
        recording.log_landmarks(viewed.landmarks.points, 0.001 * viewed.size_m)
        if viewed.mapping_poses is not None:
            edges = drawing.frusta(viewed.camera, viewed.mapping_poses, viewed.marker_m)
            recording.log("world/cameras", rerun.LineStrips3D(edges, colors=drawing.CAMERA_COLOR))
        assert state.height is not None
        floor = viewed.floor(state.method, state.occlusion, state.height)
        _log_floor(recording, viewed, state.method, floor)
        for name, along in viewed.paths.items():
            recording.log_line(f"world/path/{name}", camera_centers(along.cam_from_world))
            scores = scorer.score(along.cam_from_world)
            for step, pose in enumerate(tqdm(along.cam_from_world, desc=name, unit="view")):
                recording.stream.set_time("step", sequence=step)
                image, _ = viewed.picture(pose, viewed.visible_landmarks(state.method, state.occlusion, pose))
                recording.log_camera(f"world/path/{name}/camera", pose, camera, image)
                recording.stream.log(f"score/{name}", rerun.Scalars(scores[step]))
            recording.stream.reset_time()


def _log_floor(recording: Recording, viewed: ViewedMap, method: str, floor: Floor) -> None:
    """Score a floor and record it."""
    with tqdm(total=len(floor.cells), desc="floor", unit="location") as bar:
        while floor.score_next(8):
            bar.update(floor.n_scored - bar.n)
    if not len(floor.cells):
        return
    colors = drawing.score_colors(floor.scores, *viewed.score_range(method, floor.scores))
    centers = floor.points
    centers[:, 2] = floor.drawn_m
    half_sizes = [(floor.cell_m / 2, floor.cell_m / 2, 0.005)]
    boxes = recording.rerun.Boxes3D(centers=centers, half_sizes=half_sizes, colors=colors, fill_mode="solid")
    recording.log("world/floor", boxes)
