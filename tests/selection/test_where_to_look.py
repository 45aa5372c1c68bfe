"""The views that are selected are the best ones, of all directions, within the limits."""

from itertools import pairwise, product

import cv2
import numpy as np
import pycolmap
import pytest

from box_scenes import furnished_room
from selection.room import POINTS, WEIGHTS, write_room
from twins.directions import score_directions as score_directions_plain
from wheretolook import LocalizationMap, WhereToLook as Exported, load_scorer, poses_looking_along
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.pose_files import images_text, tum_text
from wheretolook.geometry.poses import rotation_angle_deg, rotation_looking_along
from wheretolook.mapping.depth_images import read_depth_images
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import save_glb
from wheretolook.scorers.set.directions import BatchedDirections
from wheretolook.select.waypoints import SelectionRequest, read_waypoints
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, SceneError, TableError, WeightsError
from wheretolook.visibility.hidden_points import HiddenPointRemoval

AXES = direction_lattice(60)


@pytest.fixture(scope="module")
def scorer(sparse):
    """The way to score without the façade."""
    return load_scorer(LocalizationMap.from_colmap(sparse, occlusion=HiddenPointRemoval()), WEIGHTS)


def all_scores(scorer, points):
    poses = poses_looking_along(np.repeat(points, len(AXES), axis=0), np.tile(AXES, (len(points), 1)))
    return scorer.score(poses).reshape(len(points), len(AXES))


def test_best_views_are_those_of_the_scorer(look, scorer):
    scores = all_scores(scorer, POINTS)
    views = look.best(POINTS, 3)
    assert Exported is WhereToLook
    np.testing.assert_allclose(views.score.reshape(-1, 3), -np.sort(-scores, axis=1)[:, :3], rtol=1e-6)
    np.testing.assert_allclose(views.axes[views.rank == 1], AXES[scores.argmax(axis=1)], atol=1e-9)
    np.testing.assert_allclose(views.positions, np.repeat(POINTS, 3, axis=0), atol=1e-9)
    np.testing.assert_array_equal(views.waypoint, np.repeat(np.arange(4), 3))
    np.testing.assert_array_equal(views.rank, np.tile([1, 2, 3], 4))
    np.testing.assert_allclose(look.score(views.cam_from_world), views.score, rtol=1e-6)
    starts, _ = scorer.localization_map.in_view_on_device(views.cam_from_world)
    np.testing.assert_array_equal(views.n_visible, np.diff(starts))
    assert (views.expected_inliers > 0).all() and (views.expected_inliers <= views.n_visible).all()
    np.testing.assert_array_equal(views.in_range, scorer.in_range(views.cam_from_world))


@pytest.mark.parametrize("camera", [None, ColmapCamera("SIMPLE_RADIAL", 640, 480, (320.0, 320.0, 240.0, 0.05))])
def test_all_directions_at_once_score_as_one_by_one(camera, tmp_path):
    folder = write_room(tmp_path / "sparse", text=camera is None)
    localization_map = LocalizationMap.from_colmap(folder, camera, occlusion=HiddenPointRemoval())
    scorer = load_scorer(localization_map, WEIGHTS)
    slow = all_scores(scorer, POINTS)
    fast = scorer.score_directions(POINTS, AXES)
    odds = [np.log(scores / (1 - scores)) for scores in (slow, fast)]
    assert np.ptp(slow) > 0.05
    np.testing.assert_allclose(odds[0], odds[1], atol=0.02)
    # by a camera of COLMAP, views that only it can decide may be sampled otherwise
    for limit in (512, 64) if camera is None else (512,):
        sampled, strides = score_directions_plain(scorer, POINTS, AXES, limit)
        for lanes in (1, 4):  # as on a CPU and on a GPU
            batched = BatchedDirections(localization_map, scorer.trained, AXES, limit, scorer.accuracy, lanes)
            scores, counts = batched.score(POINTS)
            np.testing.assert_allclose(scores, sampled, atol=1e-4)
            if camera is None:
                poses = poses_looking_along(np.repeat(POINTS, len(AXES), axis=0), np.tile(AXES, (len(POINTS), 1)))
                in_view = np.diff(localization_map.landmarks_in_view(poses).starts)
                np.testing.assert_array_equal(counts.ravel(), in_view)
    assert (strides.max() > 1) == (camera is None)


def test_a_sample_of_the_landmarks_ranks_as_all(tmp_path):
    localization_map = LocalizationMap.from_colmap(write_room(tmp_path / "sparse", n=6000))
    scorer = load_scorer(localization_map, WEIGHTS)
    poses = poses_looking_along(np.repeat(POINTS, len(AXES), axis=0), np.tile(AXES, (len(POINTS), 1)))
    starts, _ = localization_map.in_view_on_device(poses)
    assert np.diff(starts).max() > 1500
    slow = all_scores(scorer, POINTS)
    fast = scorer.score_directions(POINTS, AXES)
    assert np.corrcoef(slow.ravel(), fast.ravel())[0, 1] > 0.999
    rows = np.arange(len(POINTS))
    assert (slow.max(axis=1) - slow[rows, fast.argmax(axis=1)] < 0.01).all()


def test_the_sequence_is_the_best_of_all(sparse):
    look = WhereToLook.from_colmap(sparse, weights=WEIGHTS, directions=12, device="cpu")
    axes = look.directions
    limit = 60.0
    scores = look.scorer.score_directions(POINTS, axes)
    rotations = rotation_looking_along(axes)
    turns = rotation_angle_deg(rotations[:, None], rotations[None])
    best = max(
        (sum(scores[row, choice] for row, choice in enumerate(way)), way)
        for way in product(range(12), repeat=4)
        if all(turns[a, b] <= limit for a, b in pairwise(way))
    )
    views = look.best(POINTS, max_turn_deg=limit)
    np.testing.assert_allclose(views.axes, axes[list(best[1])], atol=1e-9)
    assert best[0] < scores.max(axis=1).sum()  # the limit costs something here
    turned = rotation_angle_deg(views.cam_from_world[:-1, :, :3], views.cam_from_world[1:, :, :3])
    assert (turned <= limit + 1e-4).all()


def test_waypoints_outside_the_map(look):
    given = np.concatenate([POINTS[:2], [[300.0, 2.0, 1.5]], POINTS[2:]])
    with pytest.raises(TableError):
        look.best(given)
    views = look.best(given, skip=True)
    np.testing.assert_array_equal(views.waypoint, [0, 1, 3, 4])
    np.testing.assert_allclose(views.positions, POINTS, atol=1e-9)
    with pytest.raises(TableError):
        look.best(given[2], skip=True)
    with pytest.raises(TableError):
        look.best(look.localization_map.landmarks.points[3])


def test_a_mesh_hides_landmarks_and_holds_waypoints_inside_geometry(look, sparse, tmp_path):
    save_glb(furnished_room(), tmp_path / "room.glb")
    open_room = WhereToLook.from_colmap(sparse, weights=WEIGHTS, directions=60, occlusion="none", device="cpu")
    room = WhereToLook.from_colmap(sparse, weights=WEIGHTS, directions=60, mesh=tmp_path / "room.glb", device="cpu")
    assert room.localization_map.occlusion.name == "mesh"
    axes = np.tile(AXES, (len(POINTS), 1))
    poses = poses_looking_along(np.repeat(POINTS, len(AXES), axis=0), axes)
    seen = [np.diff(w.localization_map.in_view_on_device(poses)[0]) for w in (open_room, room)]
    assert (seen[1] <= seen[0]).all() and seen[1].sum() < seen[0].sum()
    with pytest.raises(TableError):
        room.best((5.0, 1.0, 1.0))  # in the closed cabinet
    for step in (0.001, 0):
        with pytest.raises(ConfigError):
            room.grid(step)
    for finder in (room, look):  # without a mesh, free space is near the images
        grid = finder.grid(1.0)
        assert len(grid) > 5 and finder.space.is_free(grid.points).all()


def test_depth_images(sparse, tmp_path):
    model = pycolmap.Reconstruction(sparse)
    renderer = WarpRenderer(furnished_room(), "cpu")
    (tmp_path / "depth").mkdir()
    for image in model.images.values():
        pose = image.cam_from_world().matrix()[None]
        depth = renderer.render(PinholeCamera(320, 240, 160.0), pose).depth_m[0]
        millimetres = np.nan_to_num(depth, nan=0, posinf=0) * 1000
        cv2.imwrite(str(tmp_path / "depth" / f"{image.name[:-4]}.png"), millimetres.astype(np.uint16))
    look = WhereToLook.from_colmap(sparse, weights=WEIGHTS, directions=60, depth=tmp_path / "depth", device="cpu")
    assert look.localization_map.occlusion.name == "tsdf" and len(look.best(POINTS)) == 4
    with pytest.raises(SceneError):
        WhereToLook.from_colmap(sparse, weights=WEIGHTS, depth=tmp_path, device="cpu")


def test_depth_images_of_a_camera_with_distortion(tmp_path):
    """A wall at 2 m and x > 0.8 m, in images twice as large as their depth images; colours are next to the depths."""
    lens = pycolmap.Camera(model="SIMPLE_RADIAL", width=400, height=300, params=[300, 200, 150, -0.2], camera_id=1)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(lens)
    image = pycolmap.Image(name="a.color.png", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.write_text(tmp_path)
    rows, columns = np.mgrid[0:150, 0:200]
    rays = lens.cam_from_img(np.stack([columns * 2 + 1.0, rows * 2 + 1.0], axis=-1).reshape(-1, 2))
    depth = np.where(2 * rays[:, 0] > 0.8, 2000, 0).reshape(150, 200).astype(np.uint16)
    (tmp_path / "depth").mkdir()
    cv2.imwrite(str(tmp_path / "depth/a.depth.png"), depth)
    cv2.imwrite(str(tmp_path / "depth/a.color.png"), np.zeros((300, 400, 3), np.uint8))
    (read,) = read_depth_images(tmp_path, tmp_path / "depth")
    points = read.points(10)
    assert len(points) > 4000 and np.allclose(points[:, 2], 2)
    assert points[:, 0].min() == pytest.approx(0.8, abs=2 / 150)


def test_cameras(sparse):
    def camera(**options):
        return WhereToLook.from_colmap(
            sparse, weights=WEIGHTS, occlusion="none", device="cpu", **options
        ).localization_map.camera

    assert camera() == camera(camera=1) == PinholeCamera(640, 480, 320.0)
    assert camera(camera="pinhole,320,240,200,200,160,120") == PinholeCamera(320, 240, 200.0)
    assert camera(fov_deg=60) == PinholeCamera.of_field_of_view(60, 640, 480)
    assert isinstance(camera(camera="OPENCV,640,480,320,320,320,240,0.1,0,0,0"), ColmapCamera)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"camera": "PINHOLE,640,480"}, ConfigError), ({"camera": "PINHOLE,640,480,nan,320,320,240"}, ConfigError),
        ({"camera": "MAGIC,640,480,320"}, ConfigError), ({"camera": ""}, ConfigError), ({"camera": 7}, MapError),
        ({"fov_deg": 180}, ConfigError), ({"fov_deg": 1.2}, ConfigError), ({"fov_deg": 60, "camera": 1}, ConfigError),
        ({"method": "nothing"}, ConfigError), ({"method": "mlp-2d", "weights": WEIGHTS}, WeightsError),
        ({"weights": "nothing.safetensors"}, WeightsError), ({"mesh": "nothing.glb"}, SceneError),
        ({"depth": "nothing"}, SceneError), ({"occlusion": "mesh"}, ConfigError), ({"lattice": "square"}, ConfigError),
        ({"directions": 0}, ConfigError), ({"max_reprojection_error_px": -1}, ConfigError),
        ({"device": "tpu"}, ConfigError),
    ],
)  # fmt: skip
def test_invalid_options_are_rejected(sparse, options, error):
    with pytest.raises(error):
        WhereToLook.from_colmap(sparse, **{"weights": WEIGHTS, "device": "cpu", **options})


def test_looks_chosen_together_score_more_than_one(look, tmp_path):
    one = look.best(POINTS, looks=1)
    three = look.best(POINTS, looks=3)
    np.testing.assert_allclose(one.axes, look.best(POINTS).axes, atol=1e-9)
    np.testing.assert_array_equal(three.rank, np.tile([1, 2, 3], 4))
    sets = three.set_score.reshape(4, 3)
    assert (np.ptp(sets, axis=1) == 0).all() and (sets[:, 0] > one.set_score).all()
    np.testing.assert_allclose(three.positions, np.repeat(POINTS, 3, axis=0), atol=1e-9)
    near = look.best(POINTS, looks=3, max_total_turn_deg=90, pitch_deg=(-40, 20))
    rotations = near.cam_from_world.reshape(4, 3, 3, 4)[..., :3]
    assert (rotation_angle_deg(rotations[:, :-1], rotations[:, 1:]).sum(1) <= 90 + 1e-4).all()
    assert near.pitch_deg.min() >= -40 - 1e-6 and near.pitch_deg.max() <= 20 + 1e-6
    for views, written in ((three, True), (look.best(POINTS), False)):
        views.save(tmp_path / "views.csv")
        assert ("set_score" in (tmp_path / "views.csv").read_text()) == written


def test_a_sequence_stops_where_one_look_will_not_do(look, tmp_path):
    sequence = look.best(POINTS, max_turn_deg=10)
    asked = float(np.median(sequence.score))
    views = look.best(POINTS, max_turn_deg=10, looks=3, least_score=asked)
    own = views.rank == 1
    np.testing.assert_array_equal(views.cam_from_world[own], sequence.cam_from_world)
    stops = {*views.waypoint[~own].tolist()}
    assert stops and stops <= {*np.flatnonzero(sequence.score < asked).tolist()}
    for place, score in enumerate(sequence.score):
        rows = views.waypoint == place
        assert views.rank[rows].tolist() == list(range(1, 1 + rows.sum())) and np.ptp(views.set_score[rows]) == 0
        np.testing.assert_allclose(views.positions[rows] - POINTS[place], 0, atol=1e-9)
        together = views.set_score[rows][0]
        assert together > score if place in stops else together == pytest.approx(score, rel=1e-5)
    views.save(tmp_path / "views.csv")
    with pytest.raises(ConfigError):
        views.save(tmp_path / "views.tum")


@pytest.mark.parametrize(
    "options",
    [
        {"n": 0}, {"looks": 0}, {"n": 2, "looks": 2}, {"n": 2, "max_turn_deg": 30}, {"looks": 2, "max_turn_deg": 30},
        {"max_total_turn_deg": 30}, {"sigma_m": 1e300}, {"yaw_sigma_deg": 1e300},
        {"pitch_deg": (30, -30)}, {"pitch_deg": 10}, {"pitch_deg": (-100, 0)}, {"pitch_deg": (30, np.nan)},
        {"pitch_deg": (-0.5, 0.5)},  # radians
        {"pan_deg": (1, 2, 3)}, {"pan_deg": (30, -30)}, {"pan_deg": (-190, 200)},
        {"apart_deg": 20}, {"n": 2, "apart_deg": -1}, {"n": 2, "apart_deg": float("nan")},
        {"looks": 3, "least_score": 0.5},
        {"looks": 3, "max_turn_deg": 10, "least_score": 0.5, "max_total_turn_deg": 90},
    ],
)  # fmt: skip
def test_invalid_requests_are_rejected(options):
    with pytest.raises(ConfigError):
        SelectionRequest(**options)


def test_limits_on_pan_are_relative_to_the_heading(look, tmp_path):
    heading = np.array([170.0, -90.0, 0.0, 45.0])
    half = np.radians(heading) / 2
    robot = np.column_stack([np.arange(4), POINTS, np.zeros((4, 2)), np.sin(half), np.cos(half)])  # x forward, z up
    np.savetxt(tmp_path / "robot.tum", robot)
    cameras = poses_looking_along(POINTS, np.column_stack([np.cos(2 * half), np.sin(2 * half), np.zeros(4)]))
    (tmp_path / "camera.tum").write_text(tum_text("0123", cameras))
    (tmp_path / "images.txt").write_text(images_text("0123", cameras))
    table = np.column_stack([POINTS, heading])
    np.savetxt(tmp_path / "at.csv", table, delimiter=",", header="x,y,z,heading_deg", comments="")
    every_turn = {"max_turn_deg": 360.0}
    for limits, options in (
        ((-20, 60), {"n": 3}),
        ((-20, 60), {"looks": 3}),
        ((-20, 60), every_turn),
        ((-20, 60), every_turn | {"looks": 3, "least_score": 0.9999}),
        ((150, 210), {}),
    ):
        views = look.best(POINTS, heading_deg=heading, pan_deg=limits, **options)
        pan = (views.yaw_deg - heading[views.waypoint] - limits[0] + 1e-6) % 360
        assert (pan <= limits[1] - limits[0] + 2e-6).all()
    views = look.best(POINTS, 3, heading_deg=heading, pan_deg=(-20, 60))
    for name in ("robot.tum", "camera.tum", "images.txt", "at.csv"):
        same = look.best(read_waypoints(tmp_path / name), 3, pan_deg=(-20, 60))
        np.testing.assert_allclose(same.cam_from_world, views.cam_from_world, atol=1e-9)
    for options in ({}, {"heading_deg": [0, np.nan, 0, 0]}, {"heading_deg": [0]}):
        with pytest.raises(TableError):
            look.best(POINTS, pan_deg=(-20, 60), **options)
    with pytest.raises(ConfigError):
        look.best(POINTS, heading_deg=heading, pan_deg=(0, 0.01))


def test_unknown_options_and_names_of_files_are_rejected(look, sparse, tmp_path):
    with pytest.raises(ConfigError, match="heading_deg"):
        look.best(POINTS, heading=[0, 0, 0, 0])
    with pytest.raises(ConfigError, match="positions"):
        WhereToLook.from_colmap(sparse, position="k.csv")
    with pytest.raises(ConfigError, match="NUL"):
        look.best(POINTS).save(tmp_path / "a\0b.csv")


def test_positions_as_text(sparse, tmp_path):
    model = pycolmap.Reconstruction(sparse)
    rows = [f"{image.name} {' '.join(map(str, 2 * image.projection_center()))}" for image in model.images.values()]
    (tmp_path / "k.txt").write_text("\n".join(rows))
    (tmp_path / "own").mkdir()
    model.write_binary(str(tmp_path / "own"))
    look = WhereToLook.from_colmap(
        tmp_path / "own", weights=WEIGHTS, positions=str(tmp_path / "k.txt"), occlusion="none", device="cpu"
    )
    assert look.frame.world_from_map.scale == pytest.approx(2)
    with pytest.warns(MapWarning, match=r"accuracy of 50 m exceeds"):
        look.at_accuracy((50, 2))


def test_best_views_apart(look):
    near = look.best(POINTS, 4)
    apart = look.best(POINTS, 4, apart_deg=50)
    np.testing.assert_allclose(apart.axes[::4], near.axes[::4], atol=1e-9)
    for axes in apart.axes.reshape(4, 4, 3):
        cosines = (axes @ axes.T)[np.triu_indices(4, 1)]
        assert np.degrees(np.arccos(cosines)).min() >= 50
    assert (np.diff(apart.score.reshape(4, 4)) <= 0).all()
    with pytest.raises(ConfigError, match="waypoint 0 has too few views"):
        look.best(POINTS, 4, apart_deg=170)


def test_a_turn_in_radians_is_rejected(look):
    with pytest.raises(ConfigError):
        look.best(POINTS, max_turn_deg=0.5)
    assert len({*map(tuple, look.best(POINTS, max_turn_deg=0).axes.round(6).tolist())}) == 1
