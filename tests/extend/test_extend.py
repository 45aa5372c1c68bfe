"""Photographs are planned where a room is not mapped, in pairs that register; audits find where and why views fail."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from box_scenes import box_room
from colmap_models import colmap_model
from selection.room import WEIGHTS, write_room
from wheretolook.cli import main
from wheretolook.extend.audit import Audit
from wheretolook.extend.config import TargetOptions
from wheretolook.extend.places import camera_places, drawn_views, photograph_candidates, pitches_within, views_around
from wheretolook.extend.plan import Planner, fit_coverage
from wheretolook.extend.report import percent
from wheretolook.extend.surface import Patches, Surface
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import colmap_poses
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import save_glb
from wheretolook.scorers.base import CountingScorer
from wheretolook.select.waypoints import given_waypoints
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, SceneError, TableError
from wheretolook.visibility.occlusion import MeshOcclusion

SIZE = (8.0, 5.0, 3.0)
CAMERA = PinholeCamera(640, 480, 320.0)


class CountScorer(CountingScorer):
    """A probability that grows with the visible landmarks, to 1 at 100."""

    name = "set"

    def score_counts(self, n_visible, n_filled):
        return np.minimum(n_visible / 100, 1.0)


class AccurateScorer(CountScorer):
    def at_accuracy(self, accuracy):
        scorer = CountScorer(self.localization_map)
        scorer.score = lambda poses: np.full(len(poses), accuracy[0])
        return scorer


@pytest.fixture(scope="module")
def half_mapped(tmp_path_factory):
    """Return a room, with landmarks on the walls of its half of x below 4, its free space and a scorer."""
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0.2), (4, 5, 2.8), (600, 3))
    wall = rng.integers(0, 3, 600)
    points[wall == 0, 0] = 0
    points[wall == 1, 1] = 0
    points[wall == 2, 1] = 5
    centers = np.repeat([(2.6, 1.5, 1.5), (2.6, 3.5, 1.5), (3.0, 2.5, 1.5)], 3, axis=0)
    yaws = np.radians(np.tile([180, 110, 250], 3))
    poses = poses_looking_along(centers, np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(9)]))
    in_camera = np.einsum("mij,nj->mni", poses[:, :, :3], points) + poses[:, None, :, 3]
    seen = CAMERA.in_image(CAMERA.project(in_camera)) & (in_camera[..., 2] > 0)
    kept = seen.sum(axis=0) >= 2
    folder = tmp_path_factory.mktemp("half") / "sparse"
    folder.mkdir()
    colmap_model(points[kept], poses, seen[:, kept], (CAMERA,), project=False).write_binary(str(folder))
    (folder / "report.json").write_text(json.dumps({"n_landmarks": int(kept.sum())}))
    space = FreeSpace(box_room(SIZE))
    localization_map = LocalizationMap.from_colmap(folder, occlusion=MeshOcclusion(space.raycaster), scale=1.0)
    return CountScorer(localization_map), space


def planner_of(scorer, space):
    centers = camera_centers(scorer.localization_map.mapping_poses)
    places, _ = camera_places(space, centers, None, 60)
    poses, rows = drawn_views(places, 100, np.zeros(1), None, (-180, 180), 0)
    frame = scorer.localization_map.frame
    targets = Views(poses, CAMERA, "set", frame, waypoint=rows, score=scorer.score(poses))
    return Planner(scorer, space, targets, views_around(places, 8, np.zeros(1))[0])


def test_photographs_map_the_other_half_and_register(half_mapped):
    scorer, space = half_mapped
    planner = planner_of(scorer, space)
    mapped = planner.count >= 2
    assert planner.surface.name == "mesh" and planner.patches.points[mapped, 0].max() < 6.5
    plan = planner.plan(6)
    new = (planner.count >= 2) & ~mapped
    far = planner.patches.points[:, 0] > 4
    assert far[new].mean() > 0.65 and mapped[far].mean() < 0.15 and (mapped | new)[far].mean() > 0.3
    views = plan.views
    first, second = np.arange(0, 6, 2), np.arange(1, 6, 2)
    assert (views.p_registers[first] >= 0.3).all()  # by the score itself, or by what earlier pairs have mapped
    assert views.p_registers[0] == pytest.approx(scorer.score(views.cam_from_world[:1])[0])
    apart = np.linalg.norm(views.positions[first] - views.positions[second], axis=1)
    assert ((apart >= 0.35) & (apart <= 1.4)).all()
    assert views.partner == ("2", "1", "4", "3", "6", "5")
    assert len(np.unique(views.cam_from_world.round(6), axis=0)) == 6
    np.testing.assert_allclose(views.share, plan.targets.score.mean() + np.cumsum(views.gain))
    assert (views.gain > -1e-9).all() and views.share[-1] == pytest.approx(plan.predicted.mean())
    again = planner_of(scorer, space)
    usable = again.pairs[(again.registers()[again.pairs] >= 0.3).any(axis=1)]
    gains = again._gains(usable) / len(plan.targets)
    assert gains.max() > 0.02 and views.gain[:2].sum() >= 0.98 * gains.max()
    assert ((views.share_low <= views.share) & (views.share <= views.share_high)).all()


def test_gains_fall_where_all_photographs_register(half_mapped):
    gain = planner_of(*half_mapped).plan(6, least_p=0).views.gain.reshape(-1, 2).sum(axis=1)
    assert (np.diff(gain) < 0).all()


def test_a_list_ends_at_the_share_asked_for_and_an_odd_one_with_a_single_photograph(half_mapped, tmp_path):
    long = planner_of(*half_mapped).plan(5)
    assert len(long.views) == 5 and long.views.partner[-1] == ""
    until = float(long.views.share[1])
    assert len(planner_of(*half_mapped).plan(5, until=until).views) == 2
    reached = planner_of(*half_mapped).plan(5, until=0.001)
    assert len(reached.views) == 0
    np.testing.assert_allclose(reached.predicted, reached.targets.score)
    reached.views.save(tmp_path / "none.csv")


def test_large_places_have_pairs(half_mapped):
    scorer, _ = half_mapped
    space = FreeSpace(box_room((34.0, 34.0, 3.0)))
    candidates = photograph_candidates(scorer.localization_map, space, TargetOptions())
    places = np.unique(camera_centers(candidates).round(6), axis=0)
    assert len(candidates) == 8 * len(places) and 200 < len(places) <= 350 and space.is_free(places).all()
    planner = planner_of(scorer, half_mapped[1])
    planner.candidates = candidates
    assert {*planner.pairs.ravel().tolist()} == {*range(len(candidates))}
    planner.pairs = planner.pairs[:0]
    with pytest.raises(SceneError, match=r"0\.35 to 1\.4 m.*--n 1"):
        planner.plan(2)


def test_photographs_register_at_the_right_place(half_mapped):
    planner = planner_of(AccurateScorer(half_mapped[0].localization_map), half_mapped[1])
    np.testing.assert_allclose(planner.registers(), 0.5)
    views = planner.plan(2).views
    np.testing.assert_allclose(views.score, half_mapped[0].score(views.cam_from_world))


@pytest.mark.parametrize(
    ("counts", "cause"),
    [
        ((0, 0, 0, 0), "nothing mapped"),
        ((10, 0, 0, 0), "nothing mapped"),
        ((50, 5, 5, 5), "few landmarks"),
        ((50, 30, 20, 10), "too far"),
        ((50, 10, 30, 20), "too oblique"),
        ((50, 10, 20, 30), "repeated"),
    ],
)
def test_weak_regions_have_a_cause(half_mapped, counts, cause):
    # a strong place with 100 landmarks, two weak neighbours at different heights, a weak place of another storey
    centers = np.array([(0.0, 0, 1), (9, 0, 1), (10, 0, 2), (9, 0, 4)])
    columns = dict(zip(("n_visible", "n_too_far", "n_too_oblique", "n_repeated"), counts, strict=True))
    columns = {name: np.array([100 * (name == "n_visible"), *[count] * 3]) for name, count in columns.items()}
    poses = poses_looking_along(centers, (1.0, 0.0, 0.0))
    frame = half_mapped[0].localization_map.frame
    score = np.array([1.0, 0, 0, 0])
    views = Views(poses, CAMERA, "set", frame, waypoint=np.arange(4), score=score, **columns)
    places = Audit(replace(views, waypoint_id=tuple("abcd")), 1.0).places()
    assert places["region"].tolist() == [0, 1, 1, 2] and places["cause"].tolist() == ["", cause, cause, cause]


def test_a_wall_separates_weak_regions(half_mapped):
    poses = poses_looking_along(np.array([(1.0, 2, 1.5), (2, 2, 1.5), (3, 2, 1.5)]), (0.0, 1.0, 0.0))
    few = dict.fromkeys(("n_visible", "n_too_far", "n_too_oblique", "n_repeated"), np.zeros(3))
    frame = half_mapped[0].localization_map.frame
    views = Views(
        poses, CAMERA, "set", frame, waypoint=np.arange(3), waypoint_id=("a", "b", "c"), score=few["n_visible"], **few
    )
    wall = [[(2.5, 0.0, 0.0), (2.5, 5.0, 0.0), (2.5, 5.0, 3.0), (2.5, 0.0, 3.0)]]
    space = FreeSpace(box_room(SIZE, more_quads=wall, more_textures=[np.zeros((4, 4, 3), np.uint8)]))
    assert Audit(views, 1.0).places()["region"].nunique() == 1
    assert Audit(views, 1.0, space).places()["region"].tolist() == [1, 1, 2]


def test_one_place_has_no_interval():
    assert percent(0.5, np.nan, np.nan) == "50.0 %"


def test_candidates_that_are_mapping_images_are_left_out(half_mapped):
    scorer, space = half_mapped
    poses = scorer.localization_map.mapping_poses.astype(float)
    targets = Views(poses, CAMERA, "set", scorer.localization_map.frame, waypoint=np.arange(9), score=np.full(9, 0.5))
    with pytest.raises(SceneError, match="in the map"):
        Planner(scorer, space, targets, poses)


def test_a_map_in_which_nothing_registers_is_an_error_with_a_place(half_mapped):
    scorer, space = half_mapped
    planner = planner_of(scorer, space)
    planner.scores = np.full(len(planner.candidates), 0.1)
    with pytest.raises(MapError, match=r"registers.*Photograph around"):
        planner.plan(4)


def test_a_map_in_parts_is_stated(half_mapped):
    scorer, space = half_mapped
    known = scorer.localization_map.map
    alone = known.images.observation_image != 0  # the first image keeps no landmark
    of_point = np.bincount(known.images.observation_point[alone], minlength=len(known.images.points))
    images = replace(
        known.images,
        observation_start=np.concatenate([[0], np.cumsum(of_point)]),
        observation_image=known.images.observation_image[alone],
        observation_keypoint=known.images.observation_keypoint[alone],
    )
    with pytest.warns(MapWarning, match=r"1 of 9 images share no landmarks.*000\.jpg"):
        planner_of(CountScorer(replace(scorer.localization_map, map=replace(known, images=images))), space)


def test_an_image_covers_what_it_sees_from_a_similar_direction_and_distance(half_mapped):
    scorer, space = half_mapped
    surface = Surface(scorer.localization_map, space)
    target = np.array([[2.0, 2.5, 1.5]])  # looks along y at (2, 5, 1.5), 2.5 m away
    one = Patches(
        1, 1, np.zeros(1, dtype=int), np.array([[2.0, 5.0, 1.5]]), np.array([[0.0, 1, 0]]), np.array([2.5]), -np.ones(1)
    )
    at = [target[0], *((2.0 + 2 * np.tan(np.radians(angle)), 3.0, 1.5) for angle in (30, 40))]
    at += [(2.0, 5 - 2.5 / ratio, 1.5) for ratio in (2.1, 2.3)]
    poses = poses_looking_along(np.array(at), (0.0, 1.0, 0.0))
    away = poses_looking_along(target, (0.0, -1.0, 0.0))
    covering = surface.covering(one, np.concatenate([poses, away]), [CAMERA] * 6)
    np.testing.assert_array_equal(covering.toarray()[:, 0], [1, 1, 0, 1, 0, 0])
    # a camera of half the focal length sees the same size from half the distance
    wide = PinholeCamera(640, 480, 160.0)
    np.testing.assert_array_equal(surface.covering(one, poses[3:], [wide] * 2).toarray()[:, 0], [1, 1])


def test_a_wall_hides_and_landmarks_are_the_surface_without_a_mesh(half_mapped):
    scorer, _ = half_mapped
    low, high = np.array([(1.0, 4.0, 0.0), (3.0, 4.0, 3.0)])
    wall = [[low, (high[0], 4.0, 0.0), high, (low[0], 4.0, 3.0)]]
    space = FreeSpace(box_room(SIZE, more_quads=wall, more_textures=[np.zeros((4, 4, 3), np.uint8)]))
    one = Patches(
        1, 1, np.zeros(1, dtype=int), np.array([[2.0, 5.0, 1.5]]), np.array([[0.0, 1, 0]]), np.array([2.5]), -np.ones(1)
    )
    pose = poses_looking_along(np.array([[2.0, 2.5, 1.5]]), (0.0, 1.0, 0.0))
    assert Surface(scorer.localization_map, space).covering(one, pose, [CAMERA]).nnz == 0
    centers = camera_centers(scorer.localization_map.mapping_poses)
    surface = Surface(scorer.localization_map, MappedSpace(scorer.localization_map.landmarks.points, centers))
    patches = surface.patches(scorer.localization_map.mapping_poses.astype(float), 10, 8)
    assert surface.name == "landmarks" and (patches.shares(np.ones(len(patches.view), bool)) > 0.1).all()
    known = patches.landmark >= 0
    points = scorer.localization_map.landmarks.points[patches.landmark[known]]
    np.testing.assert_array_equal(patches.points[known], points)
    usual_m = np.median(scorer.localization_map.landmarks.mapping_distance_m)  # of surface that no image shows
    np.testing.assert_allclose(patches.distance_m[~known], usual_m, rtol=1e-6)
    assert 0.1 < known.mean() < 0.9


def test_scores_rise_with_coverage():
    coverage = np.linspace(0, 1, 200)
    offset, slope = fit_coverage(coverage, 1 / (1 + np.exp(3 - 8 * coverage)))
    assert offset == pytest.approx(-3, abs=0.1) and slope == pytest.approx(8, rel=0.05)
    assert fit_coverage(coverage, 1 - coverage)[1] >= 0


def test_places_are_above_the_floor_at_the_height(half_mapped):
    _, space = half_mapped
    places, apart = camera_places(space, np.array([[2.0, 2.5, 1.5]]), 0.8, 40)
    np.testing.assert_allclose(places[:, 2], 0.8, atol=0.01)
    free = (SIZE[0] - 0.5) * (SIZE[1] - 0.5)
    assert len(places) * apart**2 == pytest.approx(free, rel=0.35)
    np.testing.assert_allclose(camera_places(space, np.array([[2.0, 2.5, 1.2]]), None, 40)[0][:, 2], 1.2, atol=0.01)
    np.testing.assert_allclose(pitches_within((-30, 30)), [-30, -10, 10, 30])
    poses, rows = drawn_views(places, 80, np.array([10.0]), np.full(len(places), 90.0), (-5, 5), 0)
    assert len(poses) == 80
    yaw = np.degrees(np.arctan2(poses[:, 2, 1], poses[:, 2, 0]))
    assert (np.abs(yaw - 90) <= 5).all() and {*rows} == {*range(len(places))}
    few = drawn_views(np.repeat(places, 5, axis=0), 20, np.zeros(1), None, (-180, 180), 0)[1]
    assert len(few) == 20 and {*np.diff(few)} <= {len(places) // 4, len(places) // 4 + 1}


# --- on a map with the bundled weights


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    save_glb(box_room((6.0, 5.0, 3.0)), folder / "room.glb")
    return write_room(folder / "sparse"), folder / "room.glb"


@pytest.fixture(scope="module")
def look(room):
    return WhereToLook.from_colmap(room[0], weights=WEIGHTS, mesh=room[1], device="cpu")


def test_an_audit_has_the_mean_score_of_the_views_and_their_weak_regions(look):
    audit = look.audit(views=60)
    assert audit.share == pytest.approx(look.score(audit.views.cam_from_world).mean(), rel=1e-5)
    low, high = audit.interval
    assert low <= audit.share <= high
    places = audit.places()
    assert places["n_views"].sum() == len(audit.views)
    weak = places["share"] < 0.5
    np.testing.assert_array_equal(places["region"] > 0, weak)
    assert (places.loc[weak, "cause"] != "").all()
    assert look.audit(audit).share == pytest.approx(audit.share)


def test_targets_are_at_the_heights_above_the_floor(look, room):
    audit = look.audit([(2.0, 2.0, 1.5), (3.0, 2.0, 1.0)], views=8, height_m=(0.3, 2.5))
    expected = [(2, 2, 0.3), (3, 2, 0.3), (2, 2, 2.5), (3, 2, 2.5)]
    np.testing.assert_allclose(audit.views.positions[::2], expected, atol=1e-4)
    without_mesh = WhereToLook.from_colmap(room[0], weights=WEIGHTS, device="cpu")
    with pytest.raises(ConfigError, match="floor"):
        without_mesh.audit([(2.0, 2.0, 1.5)], height_m=(1.0,))


def test_views_outside_of_another_map_are_stated(look):
    audit = look.audit([(2.0, 2.0, 1.5)], views=4)
    views = audit.views
    poses = poses_looking_along(np.array([(2.0, 2.0, 1.5)] * 3 + [(50.0, 2.0, 1.5)]), (1.0, 0.0, 0.0))
    with pytest.warns(MapWarning, match="1 of 4 target views are outside"):
        look.audit(replace(audit, views=replace(views, cam_from_world=poses)))


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_places_of_a_map_of_unknown_scale_are_as_far_apart_in_its_unit(look, tmp_path):
    other = WhereToLook.from_colmap(write_room(tmp_path / "other", metric=False), weights=WEIGHTS, device="cpu")
    scale = other.frame.world_from_map.scale
    again = other.audit(look.audit([(2.0, 2.0, 1.5)], views=2))
    assert scale != 1 and again.apart_m == pytest.approx(scale)


def test_targets_are_those_of_a_viewpoint_map(look, tmp_path):
    grid = VoxelGrid((1.5, 1.5, 1.2), (3.5, 2.5, 1.8), (2, 1, 1))
    build_viewpoint_map(look.scorer, grid, [0, 1], np.eye(3)[:2]).save(tmp_path / "viewpoints")
    waypoints = given_waypoints([str(tmp_path / "viewpoints")])
    np.testing.assert_allclose(waypoints.points, [(2, 2, 1.5), (3, 2, 1.5)])
    assert len({*look.audit(waypoints, views=10).views.waypoint}) == 2


def test_depth_images_are_the_surface(room, tmp_path):
    poses = colmap_poses(room[0])
    depths = WarpRenderer(box_room((6.0, 5.0, 3.0))).render(PinholeCamera(160, 120, 80.0), poses).depth_m
    for row, depth in enumerate(depths):
        np.save(tmp_path / f"{row:03}.npy", depth)
    look = WhereToLook.from_colmap(room[0], weights=WEIGHTS, depth=tmp_path, device="cpu")
    assert look.extend(2, views=40, least_p=0).surface == "depth images"


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"n": 0}, ConfigError, "at least 1"),
        ({"n": 2.5}, ConfigError, "whole number"),
        ({"until": 0}, ConfigError, "until"),
        ({"least_p": 1.5}, ConfigError, "least_p"),
        ({"views": 0}, ConfigError, "views"),
        ({"height_m": (-1.0,)}, ConfigError, "height"),
        ({"pitch_deg": (20.0, -20.0)}, ConfigError, "pitch_deg"),
        ({"pan_deg": (30.0, 30.0)}, ConfigError, "pan_deg"),
        ({"heigth_m": (1.0,)}, ConfigError, "height_m"),
        ({"pan_deg": (-30.0, 30.0)}, ConfigError, "--targets"),
        ({"at": [(50.0, 0.0, 1.0)]}, TableError, "outside the map"),
        ({"at": [(2.0, 2.0, 1.5)], "pan_deg": (-30.0, 30.0)}, TableError, "heading"),
    ],
)
def test_invalid_requests_name_the_value_and_the_fix(look, options, error, text):
    with pytest.raises(error, match=text):
        look.extend(**{"n": 2, **options})


def test_scores_must_be_probabilities_and_heights_need_a_floor(room):
    without_mesh = WhereToLook.from_colmap(room[0], weights=WEIGHTS, device="cpu")
    with pytest.raises(ConfigError, match="floor"):
        without_mesh.audit(height_m=(1.0,))
    with pytest.raises(ConfigError, match="no probabilities"):
        WhereToLook.from_colmap(room[0], method="visible", device="cpu").audit()


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("out", ["photographs.csv", "photographs.json", "photographs.tum", "images.txt"])
def test_the_command_writes_poses_in_each_format(room, tmp_path, capsys, out):
    given = ["--map", str(room[0]), "--mesh", str(room[1]), "--weights", str(WEIGHTS), "--device", "cpu"]
    arguments = ["extend", *given, "--n", "2", "--views", "40", "--out", str(tmp_path / out)]
    arguments += ["--floor-plan", str(tmp_path / "plan.png")] if out.endswith("csv") else []
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "surface: mesh" in text and "predicted" in text
    views = Views.read(tmp_path / out)
    assert len(views) == 2
    if out.endswith("csv"):
        table = pd.read_csv(tmp_path / out)
        assert {"gain", "share", "share_low", "share_high", "p_registers", "partner", "overlaps"} <= {*table.columns}
        assert table["partner"].tolist() == [2, 1] and (tmp_path / "plan.png").is_file()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_audits_of_two_maps_and_several_mounts(room, tmp_path):
    other = write_room(tmp_path / "other", n=150)
    given = ["--map", str(room[0]), "--mesh", str(room[1]), "--weights", str(WEIGHTS), "--device", "cpu"]
    mounts = ["--mount", "0.5", "1.5", "--pitch", "-20", "0", "--against", str(other), "--views", "40"]
    assert main(["audit", *given, *mounts, "--out", str(tmp_path / "audit")]) == 0
    record = json.loads((tmp_path / "audit" / "audit.json").read_text())
    assert len(record) == 2 and len({result["views"] for result in record.values()}) == 1
    table = pd.read_csv(tmp_path / "audit" / "mounts.csv")
    assert table[["height_m", "pitch_deg"]].to_numpy().tolist() == [[0.5, -20], [0.5, 0], [1.5, -20], [1.5, 0]]
    assert len({*table["share"]}) == 4
    assert {"audit.csv", "audit.png", "mounts.png"} <= {path.name for path in (tmp_path / "audit").iterdir()}
