"""Plan paths on a mask for Nav2, and compare how often their views localize with the shortest paths on the same grid.

    python -m wheretolook_paper.studies.nav2 --dataset data/test-90 --scene aws_house --out data/release/results/nav2.csv

The mask is written and read as Nav2's map_server does. Paths lead over its cells, whose centres are at one height; they
have the least cost, as A* and Dijkstra's algorithm find it: a metre costs one, and `weight` times the cost of its cells in
the mask. Along the shortest path the camera looks ahead ("forward"), or along views chosen within a limit on turns ("set");
along the path on the mask ("mask"), it looks along views chosen likewise. Each view is rendered and localized.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import PIL.Image
from jsonargparse import auto_cli
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from wheretolook.commands.options import extractor_of, scene_job
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.poses import Float, poses_looking_along, turns_deg
from wheretolook.localization.config import LabelConfig
from wheretolook.planning.config import FORWARD
from wheretolook.planning.nav2 import check_mask, write_mask
from wheretolook.planning.scene_map import scene_scorer
from wheretolook.planning.stops import within_pitch
from wheretolook.planning.view_sequence import TurnLimit, best_sequence, lengths_along
from wheretolook.scorers.weights import resolve_weights
from wheretolook.select.waypoints import grid_waypoints
from wheretolook_paper.evaluation.comparison import replace_rows
from wheretolook_paper.paths.config import PathsConfig
from wheretolook_paper.paths.path_comparison import PLANNED, ComparedPaths, resample_path
from wheretolook_paper.paths.path_report import path_markdown, summarize_paths
from wheretolook_paper.paths.scene_comparison import SceneComparison, compare_scenes

SHORTEST = "set"
MASKED = "mask"
"""Methods beside "forward": the shortest path, and the path on the mask, both with chosen views."""


@dataclass(frozen=True, eq=False)
class CellGraph:
    """Cells whose neighbours, also across a corner, are connected where a camera can move straight between them.

    Attributes:
        points: centres (N, 3) m.
        edges: cells (E, 2) of each connection.
    """

    points: Float
    edges: NDArray[np.int64]

    @classmethod
    def of(cls, points: Float, space: Any, cell_m: float) -> CellGraph:
        """Connect cells so many metres wide in a space."""
        edges = cKDTree(points).query_pairs(1.5 * cell_m, output_type="ndarray")
        return cls(points, edges[space.segments_are_free(points[edges[:, 0]], points[edges[:, 1]])])

    def graph(self, cost: Float) -> coo_array:
        """Return the graph, in which a metre costs one and the mean `cost` (N,) of the two cells."""
        first, second = self.edges.T
        metres = np.linalg.norm(self.points[first] - self.points[second], axis=1)
        weights = metres * (1 + (cost[first] + cost[second]) / 2)
        return coo_array((weights, (first, second)), shape=(len(self.points),) * 2)

    def path(self, cost: Float, start: int, goal: int) -> Float:
        """Return the centres (P, 3) along the path of least cost."""
        before = dijkstra(self.graph(cost).tocsr(), directed=False, indices=start, return_predecessors=True)[1]
        cells = [goal]
        while cells[-1] != start:
            cells.append(int(before[cells[-1]]))
        return self.points[cells[::-1]]

    def draw_pairs(self, n: int, least_m: float, seed: int) -> NDArray[np.int64]:
        """Draw cells (n, 2) of the largest connected part, at least so many metres apart."""
        part = connected_components(self.graph(np.zeros(len(self.points))), directed=False)[1]
        cells = np.flatnonzero(part == np.bincount(part).argmax())
        ends = np.random.default_rng(seed).choice(cells, (100 * n, 2))
        apart = np.linalg.norm(self.points[ends[:, 0]] - self.points[ends[:, 1]], axis=1) >= least_m
        return ends[apart][:n]


def read_costs(folder: Path, points: Float, cell_m: float) -> Float:
    """Return the costs (N,), 0 to 1, that mask.yaml in the mode scale gives to points (N, 3) m."""
    with PIL.Image.open(folder / "mask.pgm") as image:
        values = np.rint(100 * (1 - np.asarray(image)[::-1] / 255)) / 100
    column, row = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / cell_m + 0.5).astype(int).T
    return np.asarray(values[row, column])


@dataclass(frozen=True, eq=False)
class MaskComparison(SceneComparison):
    """Paths on a mask and the shortest ones, in one scene, at a height in metres, by cells of a width in metres."""

    height_m: float = 1.4
    cell_m: float = 0.5
    weight: float = 3.0

    @cached_property
    def planned(self) -> ComparedPaths:
        """The paths and views of the three methods, without labels."""
        scene = self.scene
        scorer = scene_scorer(scene, "set", self.weights["set"])
        masks = self.folder / "masks"
        check_mask(masks, scorer, self.height_m)
        points = grid_waypoints(scene.localization_map, scene.space, self.cell_m, self.height_m).points
        axes = within_pitch(self.config.axes(), self.config.planner)
        scores = scorer.score_directions(points, axes)
        write_mask(masks, points, scores.max(axis=1), self.cell_m)
        costs = self.weight * read_costs(masks, points, self.cell_m)
        cells = CellGraph.of(points, scene.space, self.cell_m)
        limit = TurnLimit.of(axes, self.config.max_turn_deg)
        paths, views = [], []
        for number, (start, goal) in enumerate(cells.draw_pairs(self.config.pairs, 4.0, self.config.seed)):
            for method, cost in ((FORWARD, 0 * costs), (SHORTEST, 0 * costs), (MASKED, costs)):
                at = resample_path(cells.path(cost, start, goal), self.config.planner.spacing_m)
                if method == FORWARD:
                    ahead = np.diff(at, axis=0)
                    chosen = np.concatenate([ahead, ahead[-1:]])
                    score = np.full(len(at), np.nan)
                else:
                    sequence = best_sequence(scores[cKDTree(points).query(at)[1]], limit)
                    chosen, score = axes[sequence.direction_ids], sequence.scores
                chosen = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
                key = {"pair": number, "task": PLANNED, "method": method}
                turns = float(np.diagonal(turns_deg(chosen), 1).sum())
                length = {"length_m": lengths_along(at)[-1], "turn_deg": turns, "n_views": len(at)}
                paths.append({**key, "planned": True, **length, "promised": score.mean(), "found_by": ""})
                table = pd.DataFrame({**key, "waypoint": np.arange(len(at)), "score": score})
                views.append(table.assign(**pose_columns(poses_looking_along(at, chosen))))
        return ComparedPaths(pd.DataFrame(paths), pd.concat(views, ignore_index=True))


def main(
    dataset: Path,
    scene: str,
    out: Path | None = None,
    pairs: int = 12,
    height_m: float = 1.4,
    weight: float = 3.0,
    workers: int = 1,
    device: str = "cpu",
) -> None:
    """Compare the paths in a scene, and write their table.

    Args:
        dataset: folder of a dataset with a mesh and a map of the scene.
        scene: its name.
        out: CSV file, whose rows of other scenes are kept.
        pairs: number of starts and goals, 4 m apart or more.
        height_m: z of the camera.
        weight: metres that a metre without a view that localizes costs in addition.
        workers: worker processes.
        device: where to compute.
    """
    opened = Dataset.load(dataset)
    files = opened.scene(scene)
    label = LabelConfig(workers=workers)
    config = PathsConfig(pairs=pairs, directions=200)
    job = scene_job(files, label, extractor_of(files), device)
    weights = {"set": resolve_weights("set", dataset=opened)}
    folder = dataset / "results" / "nav2" / scene
    comparison = MaskComparison(
        Scene(files, device=device), folder, config, weights, job, print, height_m, weight=weight
    )
    compared = compare_scenes([comparison], label)
    summary = summarize_paths(compared.paths, compared.views, config)
    print(path_markdown(summary, config))
    if out is not None:
        replace_rows(out, summary, ["scene"], "%.6g")


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
