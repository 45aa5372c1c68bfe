"""What the viewer shows as a recording for the Rerun viewer: `--record`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import StorageError
from wheretolook.utils.files import atomic_write
from wheretolook.view import drawing
from wheretolook.view.scores import landmarks_seen, look_around
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState


def record(shared: Shared, path: Path, state: ViewState = ViewState()) -> None:
    """Write a recording: mesh, landmarks, mapping cameras, the floor, the state's place with its best views, the paths.

    Paths have a timeline, "step". The file is replaced in one step. Raises a StorageError if it cannot be written, a
    TableError if the state's place is outside the map.
    """
    import rerun

    opened = shared.opened
    state = replace(
        state,
        method=state.method or opened.methods[0],
        occlusion=state.occlusion or opened.occlusions[0],
        height=shared.usual_m if state.height is None else state.height,
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot be written: {error}", path=path, fix="Name a file in another folder.") from error
    with atomic_write(path) as partial:
        stream = rerun.RecordingStream("wheretolook")
        stream.save(str(partial))
        stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _scene(rerun, stream, shared, state)
        _floor(rerun, stream, shared, state)
        if state.place is not None:
            _place(rerun, stream, shared, state, np.array(state.place))
        for name, played in shared.paths.items():
            _path(rerun, stream, shared, state, name, played.cam_from_world)
        stream.flush()
        stream.disconnect()
    shared.worker.stop()


def _scene(rerun: Any, stream: Any, shared: Shared, state: ViewState) -> None:
    opened = shared.opened
    if (mesh := shared.mesh(state.cut)) is not None:
        stream.log("world/mesh", rerun.Asset3D(contents=mesh, media_type="model/gltf-binary"), static=True)
    points = rerun.Points3D(opened.landmarks.points, radii=0.001 * shared.size_m, colors=(150, 150, 155))
    stream.log("world/landmarks", points, static=True)
    if opened.mapping_poses is not None:
        edges = drawing.frusta(opened.camera, opened.mapping_poses, shared.mark_m)
        stream.log("world/cameras", rerun.LineStrips3D(edges, colors=(86, 180, 233)), static=True)


def _floor(rerun: Any, stream: Any, shared: Shared, state: ViewState) -> None:
    assert state.height is not None
    floor, look = shared.floor(state.method, state.occlusion, state.height)
    with tqdm(total=len(floor.cells), desc="floor", unit="place") as bar:
        while floor.score_next(look, 8):
            bar.update(floor.n_scored - bar.n)
    if not len(floor.cells):
        return
    at = floor.points
    low = 0.0
    high = 1.0
    if not shared.is_probability(state.method):
        low = float(floor.scores.min())
        high = float(floor.scores.max())
    at[:, 2] = floor.height_m if floor.ground_m is None else floor.ground_m + 0.03
    colors = drawing.score_colors(floor.scores, low, high)
    half = (floor.cell_m / 2, floor.cell_m / 2, 0.005)
    boxes = rerun.Boxes3D(centers=at, half_sizes=[half], colors=colors, fill_mode="solid")
    stream.log("world/floor", boxes, static=True)
    best = rerun.Arrows3D(origins=floor.points, vectors=floor.axes * 0.8 * floor.cell_m, colors=colors)
    stream.log("world/best", best, static=True)


def _place(rerun: Any, stream: Any, shared: Shared, state: ViewState, position: Float) -> None:
    place = look_around(shared.look(state.method, state.occlusion), position, state.n)
    colors = drawing.score_colors(place.scores)
    ball = rerun.Points3D(position + shared.mark_m * place.directions, colors=colors, radii=0.1 * shared.mark_m)
    stream.log("world/place/sphere", ball, static=True)
    edges = drawing.frusta(shared.opened.camera, place.best.cam_from_world, 2.2 * shared.mark_m)
    best = np.repeat(drawing.score_colors(place.best.score), 8, axis=0)
    stream.log("world/place/views", rerun.LineStrips3D(edges, colors=best), static=True)
    _view(rerun, stream, shared, state, "world/place/best", place.best.cam_from_world[0])


def _path(rerun: Any, stream: Any, shared: Shared, state: ViewState, name: str, along: Float) -> None:
    stream.log(f"world/path/{name}", rerun.LineStrips3D([camera_centers(along)]), static=True)
    report = shared.look(state.method, state.occlusion).scorer.report(along)
    for step, pose in enumerate(tqdm(along, desc=name, unit="view")):
        stream.set_time("step", sequence=step)
        _view(rerun, stream, shared, state, f"world/path/{name}/camera", pose)
        stream.log(f"score/{name}", rerun.Scalars(float(report.score[step])))
    stream.reset_time()


def _view(rerun: Any, stream: Any, shared: Shared, state: ViewState, entity: str, pose: Float) -> None:
    """A camera with its picture and the landmarks it sees."""
    opened = shared.opened
    camera = drawing.small_camera(opened.camera)
    focal = (camera.fx, camera.fy) if isinstance(camera, PinholeCamera) else camera.mean_focal_px
    scorer = shared.look(state.method, state.occlusion).scorer
    seen = landmarks_seen(scorer, pose, shared.teller(state.occlusion))
    image, _ = opened.picture(pose, seen)
    height, width = image.shape[:2]
    scale = width / camera.width
    stream.log(entity, rerun.Transform3D(translation=camera_centers(pose), mat3x3=pose[:, :3].T))
    pinhole = rerun.Pinhole(
        focal_length=np.multiply(focal, scale),
        principal_point=np.multiply(camera.principal_point, scale),
        width=width,
        height=height,
        camera_xyz=rerun.ViewCoordinates.RDF,
    )
    stream.log(entity, pinhole)
    stream.log(entity, rerun.Image(image).compress(jpeg_quality=85))
