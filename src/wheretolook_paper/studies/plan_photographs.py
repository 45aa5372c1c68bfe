"""Plan paths on a map of photographs by several methods, and localize the photographs nearest to their views.

    python -m wheretolook_paper.studies.photographs --poses kitchen --work work/kitchen
    python -m wheretolook_paper.studies.plan_photographs --map work/kitchen/map --name kitchen \
      --frame.scale 1 --frame.up 0.0089,-0.9044,-0.4265 --images kitchen --work work/kitchen/check \
      --out data/release/results/plan_photographs.csv --figure kitchen.png
    python -m wheretolook_paper.studies.photographs --images lund_door/images --work work/door
    python -m wheretolook_paper.studies.plan_photographs --map work/door/map --name lund_door \
      --images lund_door/images --work work/door/check \
      --out data/release/results/plan_photographs.csv --figure door.png

The first and third command make the maps; any COLMAP model with its features serves (`wheretolook map --images`).
Paths lead through the space near the map's cameras. The nearest photograph minimizes the angle between the optical axes
plus, in radians, the distance over the median depth of the map, by which nearby views differ; it shows the view if this
is below half the field of view. It is localized with its block of neighbours held out of the map (`wheretolook check`).

The table has a row for each view. Lengths are in metres, or if the scale is unknown in median depths. `probability` is
that of the set network for all methods. `--out` keeps the rows of other scenes; some landmarks are written beside it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist, squareform

from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.figures.floor_plan import save_figure
from wheretolook.geometry.camera import field_of_view_deg
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.holdout.holdout import choose_blocks, hold_out_blocks
from wheretolook.holdout.photo_map import PhotographedMap, features_of, open_map
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.georeference import DEPTH_M
from wheretolook.mapping.photographs import read_photograph
from wheretolook.planning.config import FORWARD, PathConfig, PlanConfig
from wheretolook.planning.rrt import Space
from wheretolook.planning.scene_map import path_views, plan_by_methods, scene_scorer
from wheretolook.scorers.weights import resolve_weights
from wheretolook.utils.errors import PlanningError
from wheretolook_paper.evaluation.comparison import replace_rows
from wheretolook_paper.figures.paths import (
    AXIS,
    LANDMARKS_CSV,
    POSITION,
    photograph_paths_figure,
    photograph_paths_markdown,
)

GRID = (8, 8, 4)
DIRECTIONS = 200
SPACING_M = 0.1  # of the views along a path
N_LANDMARKS = 2_000  # stored for drawing


def farthest_ends(space: Space, centers: Float, reach_m: float) -> tuple[int, int]:
    """Return the two camera centres (I, 3) farthest apart that straight steps of at most reach_m over others connect.

    Raises PlanningError if no two are connected.
    """
    distance = squareform(pdist(centers))
    first, second = np.nonzero(np.triu(distance <= reach_m, 1))
    clear = space.segments_are_free(centers[first], centers[second])
    steps = coo_array((np.ones(clear.sum()), (first[clear], second[clear])), shape=distance.shape)
    part = connected_components(steps, directed=False)[1]
    distance[part[:, None] != part] = 0
    if distance.max() == 0:
        raise PlanningError("no two photographs are connected by free space", value=len(centers))
    start, goal = np.unravel_index(distance.argmax(), distance.shape)
    return int(start), int(goal)


def nearest_photographs(positions: Float, axes: Float, poses: Float, depth_m: float) -> tuple[NDArray[np.intp], ...]:
    """Return, for views (W, 3), (W, 3), the nearest of poses (I, 3, 4): row, distance in m, angle in degrees, all (W,)."""
    distance = np.linalg.norm(positions[:, None] - camera_centers(poses), axis=2)
    angle = np.arccos(np.clip(axes @ poses[:, 2, :3].T, -1, 1))
    row = np.argmin(angle + distance / depth_m, axis=1)
    views = np.arange(len(row))
    return row, distance[views, row], np.degrees(angle[views, row])


def localize_held_out(source: PhotographedMap, rows: NDArray[np.intp], work: Path, workers: int) -> pd.DataFrame:
    """Localize photographs with their blocks held out; good, error_m and error_deg by name, where blocks leave a map."""
    blocks = [replace(block, tested=np.intersect1d(block.held_out, rows)) for block in choose_blocks(source)]
    results = hold_out_blocks(source, work, [block for block in blocks if block.is_part and len(block.tested)], workers)
    views = pd.concat([result.views for result in results])
    return views.set_index("image")[["good", "error_m", "error_deg"]]


def plan_on(
    scene: Scene, source: PhotographedMap, methods: tuple[str, ...], config: PlanConfig, work: Path, workers: int
) -> pd.DataFrame:
    """Plan between the ends in `config`, in the model's own frame, and return the table without the column `scene`."""
    assert config.start is not None and config.goal is not None
    localization_map = scene.localization_map
    paths = plan_by_methods(scene, None, methods, config.start, config.goal, config)
    weights = resolve_weights("set", config.weights, scene.landmarks.features)
    scorer = scene_scorer(scene, "set", weights)
    depth_m = float(np.nanmedian(source.depth_m))
    half_fov = np.radians(field_of_view_deg(scene.camera)[0]) / 2
    unit_m = 1.0 if source.is_metric else DEPTH_M
    tables = []
    for method, path in paths.items():
        row, distance, angle = nearest_photographs(path.positions, path.axes, source.poses, depth_m)
        table = pd.DataFrame({"method": method, "waypoint": np.arange(len(row))})
        table[POSITION] = path.positions / unit_m
        table[AXIS] = path.axes
        table["visible"] = [len(pixels) for pixels in path_views(path, localization_map).pixels]
        table["probability"] = scorer.score(poses_looking_along(path.positions, path.axes))
        table["image"] = np.array(source.names)[row]
        table["distance"] = distance / unit_m
        table["angle_deg"] = angle
        table["shown"] = np.radians(angle) + distance / depth_m < half_fov
        tables.append(table)
    table = pd.concat(tables, ignore_index=True)
    names = np.array(source.names)
    found = localize_held_out(source, np.flatnonzero(np.isin(names, table["image"])), work, workers)
    of_views = found.reindex(table["image"])
    table["localized"] = of_views["good"].astype(float).to_numpy()
    table["error"] = of_views["error_m"].to_numpy() / unit_m
    table["error_deg"] = of_views["error_deg"].to_numpy()
    table["unit"] = "m" if source.is_metric else "median depths"
    table["photographs"] = len(names)
    return table


def main(
    map: Path,
    work: Path,
    name: str = "",
    database: Path | None = None,
    images: Path | None = None,
    frame: FrameOptions = FrameOptions(),
    ends: tuple[str, str] | None = None,
    methods: tuple[str, ...] = (FORWARD, "fisher-trace-gp", "set"),
    time_s: float = 6.0,
    workers: int = 1,
    device: str = "cpu",
    out: Path | None = None,
    figure: Path | None = None,
) -> None:
    """Plan the paths, localize the photographs, and write the table and the figure.

    Args:
        map: folder of a COLMAP model of photographs.
        work: folder of cached work.
        name: name of the scene; by default the map's.
        database: its features; by default those found next to it.
        images: folder of its photographs, which the figure then shows.
        frame: how its frame is related to metres with z up.
        ends: names of the photographs where the paths start and end; by default the two farthest apart.
        methods: methods to plan by.
        time_s: seconds to plan each path.
        workers: worker processes.
        device: where to compute.
        out: CSV file of the table.
        figure: figure of this scene: .png, .pdf or .svg.
    """
    model, features = features_of(map, None, database, work, workers, device)
    source = open_map(model, features, name, frame)
    scene = Scene.of_colmap(ColmapFiles(model, frame=frame), device=device)
    if ends is None:
        reach_m = 2 * scene.mapped_space_config.max_camera_distance_m
        rows = farthest_ends(scene.space, camera_centers(source.poses), reach_m)
    else:
        rows = source.names.index(ends[0]), source.names.index(ends[1])
    print(f"from {source.names[rows[0]]} to {source.names[rows[1]]}")
    start, goal = (tuple(source.own_centers[row].tolist()) for row in rows)
    planner = PathConfig(time_s=time_s, spacing_m=SPACING_M)
    config = PlanConfig(grid=GRID, directions=DIRECTIONS, start=start, goal=goal, planner=planner)
    table = plan_on(scene, source, methods, config, work, workers)
    table.insert(0, "scene", source.name)
    points = scene.landmarks.points[:: max(1, len(scene.landmarks) // N_LANDMARKS), :2]
    landmarks = pd.DataFrame(points / (1 if source.is_metric else DEPTH_M), columns=["x", "y"])
    landmarks.insert(0, "scene", source.name)
    print(photograph_paths_markdown(table))
    if out is not None:
        replace_rows(out, table.round(4), ["scene"])
        replace_rows(out.with_name(LANDMARKS_CSV), landmarks.round(3), ["scene"])
    if figure is not None:
        shown = table["image"].unique() if images is not None else ()
        pictures = {image: read_photograph(images / image)[::2, ::2] for image in shown}
        save_figure(photograph_paths_figure(table, landmarks, pictures), figure)


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
