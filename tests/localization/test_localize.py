"""`wheretolook localize`: images of a rendered room against its map, alone and as a rig."""

import json
import re
from copy import copy

import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.spatial.transform import Rotation

from localization.rooms import CAMERA
from wheretolook.cli import main
from wheretolook.commands.localize import Localize
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import compose_poses, pose_error, poses_looking_along
from wheretolook.geometry.similarity import Similarity
from wheretolook.geometry.views import Views
from wheretolook.localization.rig import checked_turns, read_turns
from wheretolook.mapping.colmap_model import read_model
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.photographs import read_photograph
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.select.image_localizer import ImageLocalizer
from wheretolook.select.localized import figure_of
from wheretolook.select.query_images import cut_panorama
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import ConfigError, MapError, PoseError, TableError

AXES = np.array([(-1, 0.3, 0), (-1, -0.3, 0.1), (0.2, 1, 0)])
POSES = poses_looking_along(np.tile((2.0, 2.0, 1.4), (3, 1)), AXES)


@pytest.fixture(scope="module")
def photos(room, tmp_path_factory):
    """Images of `POSES`: a.png, b.png and c.png."""
    folder = tmp_path_factory.mktemp("photos")
    for name, rgb in zip("abc", WarpRenderer(load_mesh(room.mesh)).render(CAMERA, POSES).rgb, strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), rgb[..., ::-1])
    return folder


@pytest.fixture(scope="module")
def localizer(room):
    return ImageLocalizer.open(room.landmarks.parent)


def assert_near(poses, expected):
    error_m, error_deg = pose_error(poses, expected)
    assert (error_m < 0.05).all() and (error_deg < 0.4).all()


def test_a_batch_is_localized_and_an_unreadable_image_is_a_row_with_its_reason(room, photos, tmp_path, capsys):
    (tmp_path / "broken.png").write_bytes(b"no image")
    cut = cv2.imencode(".jpg", cv2.imread(str(photos / "a.png")))[1].tobytes()
    (tmp_path / "cut.jpg").write_bytes(cut[: len(cut) // 2])
    out = tmp_path / "poses.csv"
    images = [str(photos), str(tmp_path / "broken.png"), str(tmp_path / "cut.jpg")]
    command = ["localize", *images, "--map", str(room.landmarks.parent), "--out", str(out)]
    assert main([*command, "--figure", str(tmp_path / "figures")]) == 0
    table = pd.read_csv(out)
    assert table["image"].tolist() == ["a.png", "b.png", "c.png", "broken.png", "cut.jpg"]
    assert table["status"].tolist()[-2:] == ["error", "error"] and "broken.png" in table["reason"].iloc[-2]
    assert "not a whole one" in table["reason"].iloc[-1]
    found = table[table["status"] == "localized"]
    assert len(found) >= 2
    assert np.allclose(found[["x", "y", "z"]], (2, 2, 1.4), atol=0.05)
    assert f"localized: {len(found)} of 5" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"a.png", "b.png", "c.png"}


def test_images_of_the_same_name_in_two_folders_are_distinct(room, photos, tmp_path):
    for folder, name in (("left", "a"), ("right", "b")):
        (tmp_path / "rig" / folder).mkdir(parents=True)
        (tmp_path / "rig" / folder / "1.png").write_bytes((photos / f"{name}.png").read_bytes())
    command = ["localize", str(tmp_path / "rig"), "--map", str(room.landmarks.parent)]
    assert main([*command, "--out", str(tmp_path / "images.txt"), "--figure", str(tmp_path / "figures")]) == 0
    found = Views.read(tmp_path / "images.txt")
    assert found.waypoint_id == ("left/1.png", "right/1.png")
    assert_near(found.cam_from_world, POSES[:2])
    assert all((tmp_path / "figures" / name).is_file() for name in found.waypoint_id)
    turns = tmp_path / "turns.csv"
    yaw = np.degrees(np.arctan2(AXES[:, 1], AXES[:, 0]))
    turns.write_text(f"image,yaw,pitch\nright/1.png,{yaw[1]},5.47\nleft/1.png,{yaw[0]},0\n")
    assert main([*command, "--turns", str(turns), "--out", str(tmp_path / "images.txt")]) == 0
    found = Views.read(tmp_path / "images.txt")
    assert found.waypoint_id == ("left/1.png", "right/1.png")
    assert_near(found.cam_from_world, POSES[:2])


def test_figures_do_not_replace_the_images(room, photos, tmp_path, capsys):
    image = tmp_path / "a.png"
    image.write_bytes((photos / "a.png").read_bytes())
    command = ["localize", str(image), "--map", str(room.landmarks.parent), "--figure", str(tmp_path)]
    assert main(command) == 2
    assert "would replace" in capsys.readouterr().err
    assert image.read_bytes() == (photos / "a.png").read_bytes()


@pytest.mark.parametrize("option", ["--accuracy=0,1", "--prior=1,2"])
def test_an_invalid_option_is_an_error_of_the_batch_not_of_each_image(room, photos, tmp_path, option):
    out = tmp_path / "poses.csv"
    assert main(["localize", str(photos), "--map", str(room.landmarks.parent), option, "--out", str(out)]) == 2
    assert not out.exists()


def test_an_interrupted_batch_keeps_its_results(room, photos, tmp_path, monkeypatch):
    localize = ImageLocalizer.localize

    def interrupted(self, image, *options):
        if image.name == "c.png":
            raise KeyboardInterrupt
        return localize(self, image, *options)

    monkeypatch.setattr(ImageLocalizer, "localize", interrupted)
    out = tmp_path / "poses.csv"
    assert main(["localize", str(photos), "--map", str(room.landmarks.parent), "--out", str(out)]) == 130
    assert pd.read_csv(out)["image"].tolist() == ["a.png", "b.png"]


def test_images_are_matched_with_the_landmarks_of_their_pairs_alone(room, photos, localizer, tmp_path):
    """Of all mapping images: the same result. Of those that observe another wall: few matches, and no confident pose."""
    folder = room.landmarks.parent
    model = read_model(folder)
    axes = {image.name: image.cam_from_world().rotation.matrix()[2] for image in model.images.values()}
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("".join(f"photos/a.png {name}\n" for name in axes))
    paired = ImageLocalizer.open(folder, pairs=pairs)
    result, expected = (one.localize(photos / "a.png") for one in (paired, localizer))
    observed = {p.point3D_id for image in model.images.values() for p in image.points2D if p.has_point3D()}
    assert len(paired.pairs.landmarks("a.png")) == np.isin(localizer.landmarks.ids, [*observed]).sum()
    assert_near(result.cam_from_world, POSES[:1])
    assert result.n_matches == expected.n_matches
    opposite = [name for name, axis in axes.items() if axis @ AXES[0] < -0.9]
    pairs.write_text("".join(f"a.png {name}\n" for name in opposite) + "c.png nowhere.png\n")
    away = ImageLocalizer.open(folder, pairs=pairs).localize(photos / "a.png")
    assert away.n_matches < 0.3 * expected.n_matches and away.probability < 0.2
    assert ImageLocalizer.open(folder, pairs=pairs).localize(photos / "c.png").n_matches == 0
    with pytest.raises(TableError, match=r"b\.png.*do not name this image|do not name this image.*b\.png"):
        ImageLocalizer.open(folder, pairs=pairs).localize(photos / "b.png")


@pytest.mark.parametrize(
    ("text", "problem"),
    [("a.png one two\n", "line 1"), ("a.png nowhere.png\n", "no mapping image"), ("\x00\xff", "line 1|cannot be read")],
)
def test_damaged_pairs(room, tmp_path, text, problem):
    (tmp_path / "pairs.txt").write_bytes(text.encode("latin-1"))
    with pytest.raises(TableError, match=problem):
        ImageLocalizer.open(room.landmarks.parent, pairs=tmp_path / "pairs.txt")


def test_a_rig_whose_rotations_the_images_contradict_is_not_reported_as_localized(
    room, photos, localizer, tmp_path, capsys
):
    """The pose is kept, as the rotations are refined with it; COLMAP's file, which has no status, leaves it out."""
    yaw = np.degrees(np.arctan2(AXES[:, 1], AXES[:, 0])) + np.array((0, 8, 0))
    pitch = np.degrees(np.arcsin(AXES[:, 2] / np.linalg.norm(AXES, axis=1)))
    turns = tmp_path / "turns.csv"
    pd.DataFrame({"image": ["a.png", "b.png", "c.png"], "yaw": yaw, "pitch": pitch}).to_csv(turns, index=False)
    for name in ("pose.csv", "pose.json", "images.txt"):
        given = ["--map", str(room.landmarks.parent), "--turns", str(turns), "--out", str(tmp_path / name)]
        assert main(["localize", str(photos), *given]) == 0
    assert "localized: 0 of 1" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "pose.csv")
    rows = json.loads((tmp_path / "pose.json").read_text())["images"]
    assert table["status"].tolist() == [row["status"] for row in rows] == 3 * ["contradicted"]
    assert re.search(r"contradict the given rotations, by up to [78]\.\d degrees", table["reason"].iloc[0])
    assert np.allclose(table[["x", "y", "z"]], (2, 2, 1.4), atol=0.05)
    assert np.allclose([row["yaw_deg"] for row in rows], yaw - (0, 8, 0), atol=0.4)
    assert ".png" not in (tmp_path / "images.txt").read_text()
    result = localizer.localize([photos / f"{name}.png" for name in "abc"], turns)
    assert result.status == "contradicted"
    assert_near(result.cam_from_world, POSES)


def test_results_are_in_the_maps_own_frame_and_unit(room, photos, tmp_path):
    centimetres = Similarity(100.0, np.array([(1.0, 0, 0), (0, 0, -1), (0, 1, 0)]), np.array((50.0, 0, 0)))  # z to -y
    model = read_model(room.landmarks.parent)
    centimetres.transform_model(model)
    model.write(str(tmp_path))
    (tmp_path / "landmarks.npz").write_bytes(room.landmarks.read_bytes())
    localizer = ImageLocalizer.open(tmp_path, frame=FrameOptions(scale=0.01, up="-y"))
    result = localizer.localize(photos / "a.png", prior=(250, -140, 200, 180))
    assert_near(centimetres.inverse.apply_to_poses(result.cam_from_world), POSES[:1])
    assert 0.001 < result.deviation[0] < 5
    figure = figure_of(result, localizer.landmarks.points)
    image, plan, _ = figure.get_axes()
    assert image.get_title() == "a.png" and "100 map units" in plan.get_xlabel()


def test_a_prior_is_a_hypothesis_and_an_array_an_image(localizer, photos):
    rgb = read_photograph(photos / "b.png")
    assert_near(localizer.localize(rgb, prior=(2.3, 1.8, 1.4, -160)).cam_from_world, POSES[1:2])


RGB = np.zeros((240, 320, 3), dtype=np.uint8)
PAIR = [RGB, RGB]


@pytest.mark.parametrize(
    ("images", "option", "values", "text"),
    [
        (RGB.astype(float), "prior", [None], "array"),
        *[(images, "prior", [None], "images") for images in ([], None, 5, [None], {"a": RGB})],
        ([], "turns", [np.zeros((0, 3, 3))], "images"),
        (PAIR, "turns", [None], "rotations"),
        (PAIR, "turns", [np.ones((2, 3, 3)), np.full((2, 3, 3), np.nan), np.eye(3), [np.eye(3)] * 3, "xy", []], ""),
        (PAIR, "turns", [[np.eye(3), [1]], np.zeros(0)], ""),
        (RGB, "prior", [(1, 2), "abc", 5, (1, 2, np.nan), [[1, 2, 3]], (1, 2, 3, 4, 5)], "prior"),
        (RGB, "accuracy", ["ab", 0.1, (0.1, None), (0.0, 1.0), (0.1,), (np.nan, 1.0), (1.0, np.nan)], "accuracy"),
        (RGB, "camera", ["abc", 7.5, (1, 2), 77], "camera"),
        (np.zeros((100, 100, 3), np.uint8), "camera", [None], "the camera of this image of 100 x 100 px is unknown"),
        (np.zeros((100, 100, 3), np.uint8), "camera", [CAMERA], "proportions"),
    ],
)
def test_invalid_requests(localizer, images, option, values, text):
    for value in values:
        with pytest.raises((ConfigError, MapError, PoseError, TableError), match=text):
            localizer.localize(images, **{option: value})


def test_the_probability_is_that_of_the_accuracy(localizer, photos):
    coarse, fine = (localizer.localize(photos / "a.png", accuracy=limits) for limits in ((0.5, 5.0), (0.0005, 0.005)))
    assert coarse.probability > 0.9 and fine.probability < coarse.probability / 2
    assert_array_equal(coarse.cam_from_world, fine.cam_from_world)


@pytest.mark.parametrize("focal_px", [130.0, 160.0, 195.0])
def test_an_assumed_focal_length_is_refined_with_the_pose(room, localizer, focal_px):
    camera = PinholeCamera(320, 240, focal_px)
    rgb = WarpRenderer(load_mesh(room.mesh)).render(camera, POSES[:1]).rgb[0]
    result = localizer.localize(rgb)
    assert_near(result.cam_from_world, POSES[:1])
    row = result.table().iloc[0]
    assert row.camera_from == "assumed: camera 1 of the map" in result.describe()
    assert row.features_from == result.features_from == localizer.extractor.method
    assert row.focal_px == pytest.approx(focal_px, rel=0.01)
    assert_near(localizer.localize(rgb, camera=camera).cam_from_world, POSES[:1])


def test_the_name_of_a_mapping_image_is_not_enough_for_its_camera(localizer, photos, tmp_path):
    """Another size, or an EXIF focal length of 277 px instead of 160 px; with the photographs, other pixels."""
    name = next(iter(localizer.images.by_name))
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x920A: 27.7, 0xA20E: 254.0})  # mm, and pixels an inch
    photo = Image.open(photos / "a.png")

    def camera_from(images, image, **options):
        (tmp_path / "queries" / name).parent.mkdir(parents=True, exist_ok=True)
        image.save(tmp_path / "queries" / name, **options)
        return images.read(tmp_path / "queries" / name, name).camera_from

    assert camera_from(localizer.images, photo) == f"mapping image {name}"
    assert camera_from(localizer.images, photo.resize((160, 120))).startswith("assumed")
    assert camera_from(localizer.images, photo, exif=exif, format="JPEG").startswith("assumed")
    with_photographs = copy(localizer.images)
    with_photographs.__dict__["_photographs"] = tmp_path / "images"
    (tmp_path / "images" / name).parent.mkdir(parents=True)
    photo.save(tmp_path / "images" / name)
    assert camera_from(with_photographs, photo) == f"mapping image {name}"
    assert camera_from(with_photographs, Image.open(photos / "b.png")).startswith("assumed")


def test_a_portrait_image_has_the_camera_of_the_map_turned(localizer, photos):
    for quarters in (1, 3):
        rgb = np.ascontiguousarray(np.rot90(read_photograph(photos / "a.png"), quarters))
        result = localizer.localize(rgb)
        assert (result.cameras[0].width, result.cameras[0].height) == (240, 320)
        roll = Rotation.from_euler("z", -90 * quarters, degrees=True).as_matrix()
        assert_near(result.cam_from_world, roll @ POSES[:1])


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pixels_are_those_as_stored_whatever_the_exif_orientation(localizer, photos, tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 30  # a focal length of 277 px, which contradicts the 160 px of the map
    Image.fromarray(read_photograph(photos / "a.png")).save(tmp_path / "q.jpg", exif=exif, quality=97)
    result = localizer.localize(tmp_path / "q.jpg")
    assert_near(result.cam_from_world, POSES[:1])
    assert result.cameras[0].mean_focal_px == pytest.approx(160, rel=0.01)


def test_cameras_of_images_are_listed_as_by_hloc(room, photos, tmp_path, capsys):
    listed = tmp_path / "queries_with_intrinsics.txt"
    listed.write_text("".join(f"{photos.name}/{name}.png PINHOLE 320 240 160 160 160 120\n" for name in "ab"))
    request = ["localize", "--map", str(room.landmarks.parent), "--images", str(photos), "--camera", str(listed)]
    assert main([*request, "--out", str(tmp_path / "out.csv")]) == 0
    table = pd.read_csv(tmp_path / "out.csv").set_index("image")
    assert table.loc[["a.png", "b.png"], "camera_from"].tolist() == ["listed"] * 2
    assert "does not name this image" in table.loc["c.png", "reason"]
    listed.write_text("a.png PINHOLE 320 240 160\n")
    assert main(request) == 2 and "no camera in this line" in capsys.readouterr().err


def test_where_to_look_localizes_in_the_map_that_it_opened(room, photos):
    look = WhereToLook.from_colmap(room.landmarks.parent, method="visible", directions=60, device="cpu")
    rotations = POSES[:, :, :3] @ POSES[0, :, :3].T
    result = look.localize([photos / f"{name}.png" for name in "abc"], rotations, "SIMPLE_PINHOLE,640,480,320,320,240")
    assert_near(result.cam_from_world, POSES)
    assert result.table()["image"].tolist() == ["a.png", "b.png", "c.png"]
    with pytest.raises(ConfigError, match="from_colmap"):
        WhereToLook(look.scorer).localize(photos / "a.png")


def test_the_next_view_of_a_rig(room, photos, capsys):
    model = str(room.landmarks.parent)
    given = ["--camera", "SIMPLE_PINHOLE,640,480,320,320,240"]
    assert main(["localize", "--map", model, "--images", str(photos / "a.png"), *given, "--next"]) == 0
    assert re.search(r"next view: turn \d+ degrees to the (left|right)", capsys.readouterr().out)
    limits = ["--pitch", "20", "40", "--pan", "90", "180"]
    assert main(["localize", "--map", model, "--images", str(photos / "a.png"), *given, "--next", *limits]) == 0
    found = re.search(r"turn (\d+) degrees to the left, to a pitch of (\d+) degrees", capsys.readouterr().out)
    assert 90 <= int(found[1]) <= 180 and 20 <= int(found[2]) <= 40
    assert main(["localize", "--map", model, "--images", str(photos), *given, "--next"]) != 0
    assert "--turns" in capsys.readouterr().err


def test_an_image_is_reduced_to_the_size_of_the_maps(localizer, photos):
    assert localizer.localize(RGB).reason == "0 matches with the map"
    twice = np.asarray(cv2.resize(read_photograph(photos / "a.png"), None, fx=2, fy=2), dtype=np.uint8)
    assert_near(localizer.localize(twice).cam_from_world, POSES[:1])


def test_a_map_without_descriptors_or_with_others_is_an_error(room, tmp_path):
    folder = tmp_path / "map"
    folder.mkdir()
    for path in room.landmarks.parent.iterdir():
        if path.suffix in (".bin", ".json"):
            (folder / path.name).write_bytes(path.read_bytes())
    with pytest.raises(MapError, match="no descriptors"):
        ImageLocalizer.open(folder)
    Landmarks.load(room.landmarks).save(folder / "landmarks.npz", compact=True)
    with pytest.raises(MapError, match="no descriptors"):
        ImageLocalizer.open(folder)


def test_turns_of_odometry_and_tables(tmp_path):
    path = tmp_path / "turns.tum"
    half = np.sqrt(0.5)
    path.write_text(f"10.0 1 2 0 0 0 0 1\n10.5 1 2 0 0 0 {half} {half}\n")
    along = read_turns(path, ["10.001.png", "10.5.png"])[:, 2, :3]  # optical axes in the rig
    assert_allclose(along, [(1, 0, 0), (0, 1, 0)], atol=1e-9)
    table = tmp_path / "turns.csv"
    table.write_text("image,yaw,pitch,roll\na.png,0,0,90\nb.png,90,30,0\n")
    turned, level = read_turns(table, ["x/a.png", "x/b.png"])
    assert_allclose(turned[:, :3], [(0, 0, -1), (0, 1, 0), (1, 0, 0)], atol=1e-9)  # x down, y to the left
    assert_allclose(level[2, :3], (0, np.sqrt(0.75), 0.5), atol=1e-9)
    table.write_text("id,yaw,pitch\n0,0,0\n1,90,0\n")
    assert_allclose(read_turns(table, ["a.png", "b.png"])[1, 2, :3], (0, 1, 0), atol=1e-9)
    no_rotation = "no rotation of this image"
    for text, images, problem in (
        ("yaw,pitch\na.png,0,0\nb.png,90,30", ["a.png", "c.png"], no_rotation),
        ("yaw,pitch\na.png,0,0\nb.png,90,30", ["c.png", "d.png"], no_rotation),  # not in the order of the rows
        ("yaw,pitch\na.png,0,0\na.png,90,0", ["a.png", "b.png"], no_rotation),
        ("qw,qx,qy,qz\na.png,2,0,0,0", ["a.png"], "length 1"),
    ):
        table.write_text(f"image,{text}\n")
        with pytest.raises(TableError, match=problem):
            read_turns(table, images)


def test_rounded_rotations_are_made_orthonormal():
    exact = Rotation.from_euler("yx", [33.7, 10], degrees=True).as_matrix()
    poses = checked_turns(np.round([np.eye(3), exact], 4), 2)
    assert_allclose(poses[:, :, :3] @ poses[:, :, :3].swapaxes(1, 2), [np.eye(3)] * 2, atol=1e-12)
    assert_allclose(poses[1, :, :3], exact, atol=1e-4)


@pytest.fixture(scope="module")
def panoramas(room, tmp_path_factory):
    """Rendered panoramas of two places near the plain wall, of 2 pixels per degree, with their poses."""
    poses = poses_looking_along([(3.4, 1.2, 1.1), (4.2, 2.0, 1.3)], [(0.4, 1, 0), (0.7, -1, 0.1)])
    camera = ColmapCamera("EQUIRECTANGULAR", 720, 360, (720.0, 360.0))
    folder = tmp_path_factory.mktemp("panoramas")
    for name, rgb in zip("ab", WarpRenderer(load_mesh(room.mesh)).render(camera, poses).rgb, strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), rgb[..., ::-1])
    return folder, poses


def test_a_panorama_is_localized_jointly_where_half_of_its_cut_outs_are(room, panoramas, localizer, tmp_path):
    folder, poses = panoramas
    out = tmp_path / "images.txt"
    command = ["localize", "--panorama", str(folder), "--map", str(room.landmarks.parent), "--out", str(out)]
    assert main([*command, "--figure", str(tmp_path / "figures")]) == 0
    found = Views.read(out)
    assert found.waypoint_id == ("a.png", "b.png")
    error_m, error_deg = pose_error(found.cam_from_world, poses)
    assert (error_m < 0.02).all() and (error_deg < 0.2).all()
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"a.png", "b.png"}
    panorama = localizer.images.read(folder / "a.png", "a.png", localizer.images.known_camera("panorama"))
    faces, cam_from_rig = cut_panorama(panorama)
    right = 0
    for face, pose in zip(faces, cam_from_rig, strict=True):
        alone = localizer.localize(face.rgb, camera=face.camera)
        if alone.cam_from_world is not None:
            error_m, error_deg = pose_error(alone.cam_from_world, compose_poses(pose, poses[:1]))
            right += bool(error_m[0] < 0.02 and error_deg[0] < 0.2)
    assert 1 <= right <= 3


def test_faces_of_a_panorama_show_what_cameras_along_their_axes_see(room, panoramas, localizer):
    folder, poses = panoramas
    panorama = localizer.images.read(folder / "a.png", "a.png", ColmapCamera("EQUIRECTANGULAR", 720, 360, (720, 360)))
    faces, cam_from_rig = cut_panorama(panorama)
    assert_allclose(cam_from_rig[0], np.eye(3, 4), atol=1e-12)
    renderer = WarpRenderer(load_mesh(room.mesh))
    for face, pose in zip(faces, compose_poses(cam_from_rig, poses[0]), strict=True):
        expected = renderer.render(face.camera, pose[None]).rgb[0]
        smooth = [cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), 2) for rgb in (face.rgb, expected)]
        assert np.abs(smooth[0] - smooth[1]).mean() < 2


def test_what_is_no_panorama_is_refused_with_the_fix(room, photos, localizer):
    folder = str(room.landmarks.parent)
    with pytest.raises(ConfigError, match=r"320 x 240 px is no equirectangular panorama.*twice as wide as high"):
        localizer.localize(photos / "a.png", camera="panorama")
    with pytest.raises(ConfigError, match="several panoramas"):
        localizer.localize([np.zeros((360, 720, 3), np.uint8)] * 2, np.tile(np.eye(3), (2, 1, 1)), camera="panorama")
    with pytest.raises(ConfigError, match="either --images or --panorama"):
        Localize(map=folder)
    with pytest.raises(ConfigError, match="leave --turns"):
        Localize(map=folder, panorama=(photos / "a.png",), next=True)
