"""Plan paths on which a robot can localize: RRT* over position and orientation of the camera (paper, Sec. 4.3; OMPL)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import label
from tqdm.auto import tqdm

from wheretolook.geometry.lattices import VoxelGrid, axes_of_angles
from wheretolook.geometry.poses import Float, check_axis
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.map_frame import IDENTITY
from wheretolook.planning.config import PathConfig
from wheretolook.planning.routes import PlannedPath, RouteSamples, RouteViews
from wheretolook.planning.view_sequence import between, lengths_along
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.utils.errors import PlanningError


class Space(Protocol):
    """Free space of the camera, such as `wheretolook.space.free_space.FreeSpace`."""

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera may be at points (N, 3) m; (N,)."""

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether it may go straight from points a to points b, (N, 3) m each; (N,)."""


class _TimeBudget:
    """The time to plan, and its progress bar."""

    def __init__(self, total_s: float, bar: Any) -> None:
        self.total_s = total_s
        self.bar = bar
        self._end = time.monotonic() + total_s

    def share(self, share: float = 1.0) -> float:
        """Seconds of a share of the whole, at most those left."""
        return min(self._end - time.monotonic(), share * self.total_s)


def plan_path(
    start: ArrayLike,
    goal: ArrayLike,
    space: Space,
    bounds: ArrayLike,
    viewpoint_map: ViewpointMap | None = None,
    config: PathConfig = PathConfig(),
    start_axis: ArrayLike | None = None,
    progress: bool = True,
) -> PlannedPath:
    """Plan a path along which a robot can localize; returns the best one found in `config.time_s`.

    RRT* (Karaman and Frazzoli 2011) searches for a short path, then for positions and views jointly. The views along
    either are then chosen exactly (`best_sequence`), and the cheapest path is improved by moving its corners.

    Without a viewpoint map the path is the shortest found. The camera, fixed to the front of the robot, looks forward
    along it, as level as `PathConfig.pitch_deg` allows, without limit on rotations.

    Args:
        start: (3,) m, world.
        goal: (3,) m.
        space: free space.
        bounds: (2, 3) m, lowest and highest corner of the space to plan in.
        viewpoint_map: with scores in [0, 1].
        config: costs and limits.
        start_axis: (3,) optical axis at the start; None lets the planner choose.
        progress: whether to show a progress bar.

    Raises:
        PlanningError: the start or the goal is not free or outside the bounds; they are the same; the axis is beyond
            the camera's limits, or given without a viewpoint map; the free space does not connect them, or no path was found in time.
        ValueError: a point is not finite, or the axis has no direction.
    """
    ends = np.asarray([start, goal], dtype=np.float64)
    corners = np.array(bounds, dtype=np.float64)
    check_ends(ends, space, corners)
    viewpoint_map = viewpoint_map and viewpoint_map.in_frame(Similarity())
    if viewpoint_map is None and start_axis is not None:
        raise PlanningError("a start axis needs a viewpoint map", value=start_axis)
    problem = PathProblem(ends, corners, space, config, viewpoint_map)
    orientations = problem.start_orientations(start_axis)
    with tqdm(total=round(config.time_s, 1), desc="plan", unit="s", disable=not progress) as bar:
        budget = _TimeBudget(config.time_s, bar)
        if viewpoint_map is None:
            path = plan_shortest(problem, budget)
        else:
            axis = None if start_axis is None else axes_of_angles(np.degrees(orientations[0]))
            path = plan_informed(problem, RouteViews(viewpoint_map, config, axis), orientations, budget)
        bar.update(max(0.0, bar.total - bar.n))
    return path


def plan_shortest(problem: PathProblem, budget: _TimeBudget) -> PlannedPath:
    """Plan the shortest path, with the camera looking ahead; PlanningError if none was found."""
    route = _short_route(problem, budget, 0.5, 1.0)  # the rest of the time is for shortening it
    route = _shorten(route, problem, budget.share(), np.random.default_rng(0))
    samples = RouteSamples.of(route, problem.config.spacing_m)
    axes = _forward(samples.positions, *problem.pitch)
    unknown = np.full(len(samples.positions), np.nan)
    return PlannedPath(samples.positions, axes, unknown, float(samples.corners[-1]), "short route")


def plan_informed(
    problem: PathProblem, views: RouteViews, orientations: list[tuple[float, float]], budget: _TimeBudget
) -> PlannedPath:
    """Plan the cheapest path with views from a viewpoint map; PlanningError if none was found."""
    rng = np.random.default_rng(0)
    candidates: list[tuple[PlannedPath, Float]] = []  # with their routes

    def add(path: PlannedPath | None, route: Float, found_by: str) -> None:
        if path is not None:
            candidates.append((replace(path, found_by=found_by), route))

    def cheapest() -> tuple[PlannedPath, Float]:
        return min(candidates, key=lambda candidate: candidate[0].cost)

    search_share = 0.3  # of the time; what the short route and the search leave is for improving the cheapest path
    try:
        route = _short_route(problem, budget, 0.25, 1 - search_share)
        route = _shorten(route, problem, budget.share(0.05), rng)
        add(views.best(route), route, "short route")
    except PlanningError:
        pass  # the search below may find one
    try:
        search_s = max(1e-3, budget.share(search_share))
        states = problem.solve(
            orientations, search_s, search_s if candidates else max(1e-3, budget.share()), budget.bar
        )
        add(problem.path(states, views), states[:, :3], "search")
        add(views.best(states[:, :3]), states[:, :3], "search")
    except PlanningError:
        if not candidates:
            raise
    best, route = cheapest()

    def cost_below(candidate: Float, limit: float) -> float | None:
        if views.least_cost(candidate) >= limit:
            return None
        path = views.best(candidate)
        return None if path is None or path.cost >= limit else path.cost

    better = improve(route, cost_below, best.cost, problem, budget.share(), rng)
    if better is not route:
        add(views.best(better), better, "improvement")
    return cheapest()[0]


def _short_route(problem: PathProblem, budget: _TimeBudget, share: float, max_share: float) -> Float:
    """Find a short route (S, 3) m in a share of the time, or up to `max_share` until there is one."""
    time_s = share * budget.total_s
    max_s = max_share * budget.total_s
    shortest = PathProblem(problem.ends, problem.bounds, problem.space, problem.config)
    return shortest.solve([(0.0, 0.0)], time_s, max_s, budget.bar)[:, :3]


def check_ends(ends: Float, space: Space, bounds: Float, map_from_world: Similarity = IDENTITY.world_from_map) -> None:
    """Raise a PlanningError unless start and goal (2, 3) m are different positions in free space.

    The error has coordinates of the map.
    """
    if not np.isfinite(ends).all():
        raise ValueError(f"start and goal must be finite, got {ends.tolist()}")
    low, high = bounds
    for name, point in zip(("start", "goal"), ends, strict=True):
        if not ((point >= low) & (point <= high)).all() or not space.is_free(point[None])[0]:
            there = low + (high - low) * np.random.default_rng(0).random((4096, 3))
            free = there[space.is_free(there)]
            fix = "Give a point where the camera can be"
            if len(free):
                near = map_from_world.apply(free[np.linalg.norm(free - point, axis=1).argmin()])
                fix += f", such as {near[0]:.2f},{near[1]:.2f},{near[2]:.2f}"
            value = tuple(map_from_world.apply(point).round(6).tolist())
            raise PlanningError(f"the {name} is not in free space", value=value, fix=f"{fix}.")
    if np.linalg.norm(ends[1] - ends[0]) < 1e-6:
        raise PlanningError("the start is the goal", value=tuple(map_from_world.apply(ends[0]).tolist()))


def are_separate(ends: Float, space: Space, bounds: Float) -> bool:
    """Whether start and goal (2, 3) m are in different parts of the free space, as far as a grid shows."""
    size = np.diff(bounds, axis=0)[0]
    # cells of 10 cm, larger if there would be more than 100,000
    nx, ny, nz = (size / max(0.1, np.cbrt(size.prod() / 100_000))).astype(int) + 1
    grid = VoxelGrid.over(bounds, (nx, ny, nz))
    free = space.is_free(grid.centers()).reshape(grid.shape)
    parts, _ = label(free, np.ones((3, 3, 3)))
    start, goal = parts.ravel()[grid.location_ids(ends)]
    return bool(start and goal and start != goal)  # 0 is not free


def _shorten(route: Float, problem: PathProblem, seconds: float, rng: np.random.Generator) -> Float:
    """Shorten a free route (S, 3) m by `improve`."""

    def length_below(candidate: Float, limit: float) -> float | None:
        length = float(lengths_along(candidate)[-1])
        return length if length < limit - 1e-9 else None

    return improve(route, length_below, float(lengths_along(route)[-1]), problem, seconds, rng)


def improve(
    route: Float,
    cost_below: Callable[[Float, float], float | None],
    cost: float,
    problem: PathProblem,
    seconds: float,
    rng: np.random.Generator,
) -> Float:
    """Improve a free route (S, 3) m by shortcuts and by moving, adding and removing corners; returns the cheapest found.

    Every route tried is in free space and keeps its ends.

    Args:
        route: (S, 3) m, corners.
        cost_below: cost of a route if less than a limit, else None.
        cost: of the route.
        problem: space and bounds.
        seconds: time limit.
        rng: of the variations.
    """
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        candidate, first, last = propose_route_change(route, problem.bounds, rng)
        # only the changed segments need to be tested
        if not problem.space.segments_are_free(candidate[first:last], candidate[first + 1 : last + 1]).all():
            continue
        lower = cost_below(candidate, cost)
        if lower is not None:
            route = candidate
            cost = lower
    return route


def propose_route_change(route: Float, bounds: Float, rng: np.random.Generator) -> tuple[Float, int, int]:
    """Draw a variation of a route (S, 3) m; returns it, and the first and last corner between which it differs."""
    n = len(route)
    low, high = bounds
    step = np.exp(rng.uniform(*np.log((0.05, 1.0))))  # standard deviation, metres
    kind = rng.integers(4) if n > 2 else rng.integers(2)
    if kind == 0:  # a new corner near a random point of the route
        after = int(rng.integers(1, n))
        t = rng.random()
        new = route[after - 1] * (1 - t) + route[after] * t + rng.normal(0, step, 3)
        return np.insert(route, after, new.clip(low, high), axis=0), after - 1, after + 1
    if kind == 1:  # a shortcut between two random points of the route
        at = lengths_along(route)
        a, b = np.sort(rng.uniform(0, at[-1], 2))
        ends = between(at, route, np.array([a, b]))
        before = int((at < a).sum())
        after = int((at <= b).sum())
        return np.concatenate([route[:before], ends, route[after:]]), before - 1, before + 2
    row = int(rng.integers(1, n - 1))
    if kind == 2:  # remove a corner
        return np.delete(route, row, axis=0), row - 1, row
    moved = route.copy()
    moved[row] = (moved[row] + rng.normal(0, step, 3)).clip(low, high)
    return moved, row - 1, row + 1


class PathProblem:
    """A planning problem over states x, y, z (m), yaw, pitch (radians); without a map the last two do not matter.

    `ends` (2, 3) m are start and goal, `bounds` (2, 3) m the corners of the space to plan in.
    """

    def __init__(
        self, ends: Float, bounds: Float, space: Space, config: PathConfig, viewpoint_map: ViewpointMap | None = None
    ) -> None:
        self.ends = ends
        self.bounds = bounds
        self.space = space
        self.config = config
        self.map = viewpoint_map
        self.pitch = tuple(map(math.radians, config.pitch_deg))
        if viewpoint_map is not None:
            self._score = viewpoint_map.scores.item
            self._table = _nearest_directions(viewpoint_map.directions)

    def start_orientations(self, axis: ArrayLike | None) -> list[tuple[float, float]]:
        """Return yaws and pitches that a path may start with, in radians."""
        if self.map is None:
            return [(0.0, 0.0)]
        if axis is None:
            middle = (self.pitch[0] + self.pitch[1]) / 2
            return [(2 * math.pi * k / 12 - math.pi, middle) for k in range(12)]
        x, y, z = check_axis(axis)
        yaw = math.atan2(y, x)
        pitch = math.asin(z)
        if not self.pitch[0] - 1e-6 <= pitch <= self.pitch[1] + 1e-6:
            problem = f"the pitch of the start axis must be within {self.config.pitch_deg} degrees"
            raise PlanningError(problem, value=round(math.degrees(pitch), 1))
        return [(yaw, min(max(pitch, self.pitch[0]), self.pitch[1]))]

    def motion_cost(self, a: tuple[float, ...], b: tuple[float, ...]) -> float:
        """Compute the cost of going straight from one state to another."""
        length = math.dist(a[:3], b[:3])
        if self.map is None:
            return length
        config = self.config
        n = max(1, math.ceil(length / config.spacing_m))
        turn = _wrapped(b[3] - a[3])
        score = 0.0
        for k in range(n):
            t = (k + 0.5) / n
            at = (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2]))
            score += self.score(at, a[3] + t * turn, a[4] + t * (b[4] - a[4]))
        return length * (1 + config.score_weight * (1 - score / n)) + config.turn_weight_m * _angle(a[3:], b[3:])

    def score(self, point: tuple[float, float, float], yaw: float, pitch: float) -> float:
        """Look up the score of a view, 0 outside the map's free voxels."""
        assert self.map is not None
        row = self.map.row(point)
        if row < 0:
            return 0.0
        rows, columns = self._table.shape
        i = int((pitch + math.pi / 2) / math.pi * rows)
        j = int((yaw + math.pi) / (2 * math.pi) * columns) % columns
        return float(self._score(row, int(self._table[min(max(i, 0), rows - 1), j])))

    def motion_is_possible(self, a: tuple[float, ...], b: tuple[float, ...]) -> bool:
        """Whether the camera can go straight from one state to another."""
        if self.map is not None:
            limit = math.radians(self.config.max_turn_deg_per_m) * math.dist(a[:3], b[:3])
            # the sum of yaw and pitch is never less than the angle between the axes, so the limit holds
            if abs(_wrapped(b[3] - a[3])) + abs(b[4] - a[4]) > limit:
                return False
        return bool(self.space.segments_are_free([a[:3]], [b[:3]])[0])

    def solve(self, orientations: list[tuple[float, float]], time_s: float, max_s: float, bar: Any) -> Float:
        """Return the states (S, 5) of the best path found in `time_s`, or else of the first one found until `max_s`.

        Raises PlanningError if no path was found.
        """
        from ompl import base, geometric, util

        util.setLogLevel(util.LOG_NONE)
        # without a map nothing depends on where the camera looks: the pitch has next to no range, the yaw no weight
        pitch = self.pitch if self.map is not None else (-1e-6, 1e-6)
        low, high = self.bounds
        space = _state_space(low, high, pitch, 0.2 if self.map is not None else 1e-6)
        information = base.SpaceInformation(space)
        information.setStateValidityChecker(lambda state: bool(self.space.is_free([_numbers(state)[:3]])[0]))
        possible = self.motion_is_possible
        cost_of = self.motion_cost

        class Motions(base.MotionValidator):
            def checkMotion(self, a: Any, b: Any, *rest: Any) -> bool:
                return possible(_numbers(a), _numbers(b))

        class Costs(base.OptimizationObjective):
            def stateCost(self, state: Any) -> Any:
                return base.Cost(0.0)

            def motionCost(self, a: Any, b: Any) -> Any:
                return base.Cost(cost_of(_numbers(a), _numbers(b)))

        information.setMotionValidator(Motions(information))
        information.setup()
        definition = base.ProblemDefinition(information)
        for yaw, start_pitch in orientations:
            state = space.allocState()
            for index, number in enumerate((*self.ends[0], start_pitch)):
                state[0][index] = float(number)
            state[1].value = float(yaw)
            definition.addStartState(state)
        goal_region = base.GoalSpace(information)
        goal_region.setSpace(_state_space(self.ends[1] - 1e-9, self.ends[1] + 1e-9, pitch, 1.0))
        definition.setGoal(goal_region)
        objective = Costs(information)
        definition.setOptimizationObjective(objective)
        planner = geometric.RRTstar(information)
        planner.setProblemDefinition(definition)
        planner.setRange(1.0)  # longer straight pieces seldom stay free indoors
        planner.setup()
        step = max(1e-3, min(0.25, time_s))
        spent = 0.0
        while spent < time_s - 1e-9 or (spent < max_s - 1e-9 and not definition.hasExactSolution()):
            planner.solve(step)
            spent += step
            bar.update(min(step, max(0.0, bar.total - bar.n)))
        if not definition.hasExactSolution():
            if are_separate(self.ends, self.space, self.bounds):
                problem = "start and goal seem to be in separate parts of the free space"
                fix = (
                    "Give two positions of one part, or allow narrower passages: --scenes.free_space.clearance_m 0.15, "
                )
                fix += "without a mesh --scenes.mapped_space.max_camera_distance_m 1.5."
                raise PlanningError(problem, value=self.ends.tolist(), fix=fix)
            fix = "Give it more time, such as --plan.planner.time_s 30, or loosen the camera's limits."
            raise PlanningError("no path was found in time", value=f"{spent:.2g} s", fix=fix)
        solution = definition.getSolutionPath()
        return np.array([_numbers(solution.getState(index)) for index in range(solution.getStateCount())])

    def path(self, states: Float, views: RouteViews) -> PlannedPath:
        """Return the path through states (S, 5) with their views."""
        samples = RouteSamples.of(states[:, :3], self.config.spacing_m)
        angles = np.column_stack([np.unwrap(states[:, 3]), states[:, 4]])
        axes = axes_of_angles(np.degrees(between(samples.corners, angles, samples.along)))
        return views.costed(samples.positions, axes)


def _state_space(low: Float, high: Float, pitch: tuple[float, ...], yaw_weight: float) -> Any:
    """Make OMPL's space of states: x, y, z and pitch within bounds, and the yaw, with its weight in distances."""
    from ompl import base

    space = base.CompoundStateSpace()
    place = base.RealVectorStateSpace(4)
    bounds = base.RealVectorBounds(4)
    for index, ends in enumerate(zip((*low, pitch[0]), (*high, pitch[1]), strict=True)):
        bounds.setLow(index, float(ends[0]))
        bounds.setHigh(index, float(ends[1]))
    place.setBounds(bounds)
    space.addSubspace(place, 1.0)
    space.addSubspace(base.SO2StateSpace(), yaw_weight)
    return space


def _forward(positions: Float, lowest: float, highest: float) -> Float:
    """Unit axes (W, 3) that look along a path (W, 3), as level as limits of the pitch in radians allow.

    Where the path goes straight up or down, the yaw stays as before.
    """
    steps = np.gradient(positions, axis=0)[:, :2]
    if not (np.linalg.norm(steps, axis=1) > 1e-9).any():
        steps[:] = (1.0, 0.0)
    length = np.linalg.norm(steps, axis=1)
    known = length > 1e-9
    last = np.maximum.accumulate(np.where(known, np.arange(len(steps)), int(np.argmax(known))))
    level = steps[last] / length[last, None]
    least = min(max(0.0, lowest), highest)
    return np.column_stack([level * math.cos(least), np.full(len(level), math.sin(least))])


def _numbers(state: Any) -> tuple[float, float, float, float, float]:
    """x, y, z, yaw, pitch of a state."""
    place = state[0]
    return place[0], place[1], place[2], state[1].value, place[3]


def _wrapped(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    return math.remainder(angle, 2 * math.pi)


def _angle(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Angle between two axes, each by yaw and pitch, in radians."""
    cosine = math.sin(a[1]) * math.sin(b[1]) + math.cos(a[1]) * math.cos(b[1]) * math.cos(a[0] - b[0])
    return math.acos(min(1.0, max(-1.0, cosine)))


def _nearest_directions(directions: Float) -> NDArray[np.int64]:
    """Table of the direction nearest to the centre of each cell of pitch (rows) and yaw (columns)."""
    pitch = np.arange(-89, 90, 2)  # every two degrees
    yaw = np.arange(-179, 180, 2)
    axes = axes_of_angles(np.stack(np.meshgrid(yaw, pitch), axis=-1))
    return np.asarray((axes @ directions.T).argmax(-1))
