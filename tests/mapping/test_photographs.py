"""Photographs in folders: pixels, cameras, pairs."""

import os

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from wheretolook.mapping.config import PhotographsConfig
from wheretolook.mapping.imported_map import are_turned
from wheretolook.mapping.photographs import (
    exif_focal_px,
    list_photographs,
    photograph_cameras,
    read_photograph,
    reduce_photograph,
)
from wheretolook.utils.errors import ConfigError, MapError

ORIENTATION = 0x0112
EXIF_IFD = 0x8769
FOCAL_35MM = 0xA405


def save(path, rgb, orientation=1, focal_mm=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    if focal_mm:
        exif.get_ifd(EXIF_IFD)[FOCAL_35MM] = focal_mm
    Image.fromarray(rgb).save(path, exif=exif, quality=95)


def sized(height, width):
    return np.full((height, width, 3), 90, np.uint8)


def cameras_of(folder, config, reduction=1.0):
    names = list_photographs(folder)
    full = np.array([read_photograph(folder / name).shape[1::-1] for name in names])
    return photograph_cameras(folder, names, full, (full * reduction).astype(np.int64), config)


def test_photographs_are_listed_by_name(tmp_path):
    for name in ("b.JPG", "a.png", "hall/c.jpg"):
        save(tmp_path / name, sized(20, 30))
    (tmp_path / "notes.txt").write_text("not a photograph")
    assert list_photographs(tmp_path) == ["a.png", "b.JPG", "hall/c.jpg"]


def test_depth_images_are_no_photographs(tmp_path, caplog):
    for name in ("a.color.jpg", "b.color.png"):
        save(tmp_path / name, sized(20, 30))
    Image.fromarray(np.full((20, 30), 90, np.uint8)).save(tmp_path / "grey.png")
    for name in ("a.depth.png", "b.depth.png"):
        Image.fromarray(np.full((20, 30), 1500, np.uint16)).save(tmp_path / name)
    assert list_photographs(tmp_path) == ["a.color.jpg", "b.color.png", "grey.png"]
    assert "2 depth images" in caplog.text


def test_grey_of_more_bits_than_8_is_read(tmp_path):
    grey = np.arange(600, dtype=np.uint16).reshape(20, 30) * 255 // 599
    for name, values in {"a.png": grey, "b.png": grey * 257, "c.tiff": grey * 16, "d.tiff": grey * 4}.items():
        Image.fromarray(values if values.max() > 255 else values.astype(np.uint8)).save(tmp_path / name)
    assert list_photographs(tmp_path) == ["a.png", "b.png", "c.tiff", "d.tiff"]
    for name in "b.png", "c.tiff", "d.tiff":
        np.testing.assert_array_equal(read_photograph(tmp_path / name)[..., 0], grey)


def test_pixels_of_32_bits_are_rejected(tmp_path):
    Image.fromarray(np.zeros((20, 30), np.float32)).save(tmp_path / "a.tiff")
    with pytest.raises(MapError, match="8-bit"):
        read_photograph(tmp_path / "a.tiff")


def test_other_formats_are_counted_and_links_followed_once(tmp_path, caplog):
    for name in ("photos/a.jpg", "elsewhere/b.jpg", "elsewhere/c.jpg"):
        save(tmp_path / name, sized(20, 30))
    for name in ("d.HEIC", "e.heic", "f.dng"):
        (tmp_path / "photos" / name).touch()
    for link, target in (("cam0", "elsewhere"), ("cam1", "elsewhere"), ("loop", "photos")):
        (tmp_path / "photos" / link).symlink_to(tmp_path / target)
    assert list_photographs(tmp_path / "photos") == ["a.jpg", "cam0/b.jpg", "cam0/c.jpg"]
    assert "1 .dng, 2 .heic" in caplog.text


def test_names_that_colmap_cannot_read_are_rejected(tmp_path):
    for name in (b"a.png", b"caf\xe9.png", "ä.png".encode()):
        (tmp_path / os.fsdecode(name)).touch()
    with pytest.raises(MapError, match="UTF-8"):
        list_photographs(tmp_path)
    (tmp_path / os.fsdecode(b"caf\xe9.png")).unlink()
    assert list_photographs(tmp_path) == ["a.png", "ä.png"]


def test_photographs_are_turned_upright_and_reduced(tmp_path):
    rgb = sized(40, 60)
    rgb[:, :20] = (250, 10, 10)  # red at the left
    save(tmp_path / "turned.jpg", rgb, orientation=6)  # to be shown turned by 90 degrees clockwise
    upright = read_photograph(tmp_path / "turned.jpg")
    assert upright.shape == (60, 40, 3)
    assert upright[5, 20, 0] > 200 > upright[50, 20, 0]
    assert reduce_photograph(upright, 30).shape == (30, 20, 3)
    assert reduce_photograph(upright, 0) is upright and reduce_photograph(upright, 60) is upright


def test_focal_lengths_and_shared_cameras_from_exif(tmp_path):
    for name in ("a.jpg", "b.jpg"):
        save(tmp_path / name, sized(240, 360), focal_mm=28)
    save(tmp_path / "c.jpg", sized(240, 360), focal_mm=50)
    save(tmp_path / "d.jpg", sized(240, 360))
    save(tmp_path / "e.jpg", sized(240, 360), orientation=6, focal_mm=28)
    found = cameras_of(tmp_path, PhotographsConfig(), reduction=0.5)
    assert found.camera_of.tolist() == [0, 0, 1, 2, 3] and found.n_known_focal == 3 and not found.given
    wide, tele, unknown, turned = found.cameras
    assert (wide.width, wide.height, wide.model_name) == (180, 120, "SIMPLE_RADIAL")
    assert tele.mean_focal_length() / wide.mean_focal_length() == pytest.approx(50 / 28, rel=0.01)
    assert wide.mean_focal_length() == pytest.approx(28 / 36 * 180, rel=0.05)
    assert unknown.mean_focal_length() == pytest.approx(1.2 * 180) and not unknown.has_prior_focal_length
    assert (turned.width, turned.height) == (120, 180)
    assert turned.mean_focal_length() == pytest.approx(wide.mean_focal_length())
    apart = cameras_of(tmp_path, PhotographsConfig(shared_camera=False))
    assert apart.camera_of.tolist() == [0, 1, 2, 3, 4]


def test_the_resolution_of_a_sensor_is_that_of_the_photograph_as_taken(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(EXIF_IFD).update({0x920A: 5.0, 0xA20E: 800.0, 0xA210: 4, 0xA002: 4000, 0xA003: 3000})  # 4,000 px wide
    Image.fromarray(sized(300, 400)).save(tmp_path / "small.jpg", exif=exif)
    assert exif_focal_px(tmp_path / "small.jpg") == pytest.approx(5 * 800 / 10)
    for name, focal_mm in (("none.jpg", 0), ("short.jpg", 1), ("long.jpg", 65535)):
        save(tmp_path / name, sized(300, 400), focal_mm=focal_mm)
        assert exif_focal_px(tmp_path / name) is None


@pytest.mark.parametrize("as_upright", [False, True])
def test_keypoints_decide_whether_a_model_read_photographs_upright(tmp_path, as_upright):
    rgb = np.random.default_rng(0).integers(0, 255, (15, 20, 3), dtype=np.uint8)
    rgb = cv2.resize(rgb, (320, 240), interpolation=cv2.INTER_CUBIC)
    save(tmp_path / "a.jpg", rgb, orientation=3)
    read = cv2.cvtColor(read_photograph(tmp_path / "a.jpg", as_upright), cv2.COLOR_RGB2GRAY)
    pixels = np.array([keypoint.pt for keypoint in cv2.SIFT_create(200).detect(read, None)]) + 0.5
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 300, 320, 240))
    image = pycolmap.Image(name="a.jpg", camera_id=1, image_id=1, keypoints=pixels)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for n in range(len(pixels)):
        model.add_point3D(np.array([0, 0, 1.0]), pycolmap.Track([pycolmap.TrackElement(1, n)]))
    assert are_turned(model, tmp_path) is as_upright


def test_intrinsics_can_be_given(tmp_path):
    for name in ("a.jpg", "b.jpg"):
        save(tmp_path / name, sized(240, 360))
    config = PhotographsConfig(camera_model="PINHOLE", camera_params=(300.0, 310.0, 181.0, 119.0))
    found = cameras_of(tmp_path, config, reduction=0.5)
    assert found.given and found.cameras[0].params.tolist() == [150.0, 155.0, 90.5, 59.5]
    with pytest.raises(ConfigError):
        cameras_of(tmp_path, PhotographsConfig(camera_model="PINHOLE", camera_params=(300.0,)))
    with pytest.raises(ConfigError):
        cameras_of(tmp_path, PhotographsConfig(camera_model="POLAROID"))
    save(tmp_path / "c.jpg", sized(360, 240))
    with pytest.raises(ConfigError):
        cameras_of(tmp_path, config)
