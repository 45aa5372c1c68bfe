"""The nodes under ROS, in processes of their own: frames, stamps, covariance, and all bad input."""

import json
import time

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed: pip install '.[ros]'")

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CompressedImage, JointState, RegionOfInterest
from wheretolook_ros.conversions import grey_image, pose_matrix, pose_message

from ros.processes import CAMERA, HEAD, JOINTS, Robot, base_at, image_of, info_of, jpeg_of, mosaic, running
from ros.room import room_mesh
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import compose_poses, invert_poses
from wheretolook.rendering.warp_renderer import WarpRenderer

BASE = base_at(3.2, 2.4, 30.0)
LOCALIZER = "wheretolook_ros.localizer"
GAZE = "wheretolook_ros.gaze"
OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR


@pytest.fixture(scope="module")
def robot(context, folder):
    """A robot whose images a localizer in another process localizes."""
    node = Robot(WarpRenderer(room_mesh()))
    with running(LOCALIZER, {"folder": folder}):
        node.connected("image", "camera_info", "odom", "joint_states", "initialpose", "image/compressed")
        status = node.see(image_of(node.rgb(BASE)))
        assert status.level == ERROR and "no camera_info received yet" in status.message
        node.see(image_of(node.rgb(BASE)), info_of(CAMERA))
        yield node
    node.destroy_node()


def image_of_16_bits(values):
    """A mono16 image with values (H, W)."""
    image = image_of(values.view(np.uint8).reshape(*values.shape, 2), "mono16")
    image.is_bigendian = int(values.dtype.byteorder == ">")
    return image


def localizes_again(robot):
    """The node still runs: the next image, with a good camera, is localized."""
    assert robot.see(image_of(robot.rgb(BASE)), info_of(CAMERA)).message == "localized"
    robot.localized(BASE)


def test_frame_stamp_and_covariance(robot):
    for number, yaw in enumerate((0.0, 100.0, 200.0)):
        base = base_at(2.6 + 0.3 * number, 2.3, yaw)
        joints = (0.4, -0.2)
        status = robot.see(image_of(robot.rgb(base, *joints)), info_of(CAMERA), joints=joints)
        values = {pair.key: pair.value for pair in status.values}
        assert status.level == OK and json.loads(values["probabilities"])[0] > 0.95 and int(values["n_inliers"]) > 100
        robot.localized(base)
        found = robot.last("visual_localization/pose")
        assert found.header.frame_id == "map" and found.header.stamp.sec == int(robot.stamp)
        covariance = np.array(found.pose.covariance).reshape(6, 6)
        np.testing.assert_allclose(covariance, covariance.T)
        deviation = np.sqrt(np.diagonal(covariance))
        assert (deviation > 0).all() and deviation[:3].max() < 0.02 and deviation[3:].max() < np.radians(0.4)
        assert (np.abs(pose_matrix(found.pose.pose)[:, 3] - base[:, 3]) < 6 * deviation[:3]).all()


@pytest.mark.parametrize(
    "encoding", ["bgr8", "rgba8", "mono8", "mono16", "mono16 of 12 bits", "bayer_rggb8", "bayer_gbrg8", "compressed"]
)
def test_encodings(robot, encoding):
    rgb = robot.rgb(BASE)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    images = {
        "bgr8": lambda: image_of(rgb[:, :, ::-1], encoding),
        "rgba8": lambda: image_of(np.dstack([rgb, np.full_like(grey, 255)]), encoding),
        "mono8": lambda: image_of(grey, encoding),
        "mono16": lambda: image_of_16_bits(grey.astype("<u2") * 256),
        "mono16 of 12 bits": lambda: image_of_16_bits(grey.astype("<u2") * 16 + 7),
        "bayer_rggb8": lambda: image_of(mosaic(rgb, "rggb"), encoding),
        "bayer_gbrg8": lambda: image_of(mosaic(rgb, "gbrg"), encoding),
        "compressed": lambda: jpeg_of(rgb),
    }
    assert robot.see(images[encoding](), info_of(CAMERA)).message == "localized"
    robot.localized(BASE)


def test_a_compressed_image_that_would_fill_the_memory():
    """Its size is read before it is decoded."""
    png = cv2.imencode(".png", np.zeros((12_000, 12_000), np.uint8))[1].tobytes()
    assert len(png) < 1_000_000
    with pytest.raises(ValueError, match="12000 x 12000 px, but camera_info says 640 x 480"):
        grey_image(CompressedImage(format="png", data=png), (640, 480))
    hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 40000 +X 40000\n" + bytes(50)
    with pytest.raises(ValueError, match="cannot decode"):
        grey_image(CompressedImage(format="hdr", data=hdr), (640, 480))


def test_16_bits_are_shifted_by_the_brightest_pixel():
    """No field of an Image states how many of its 16 bits a camera uses; a black image stays black."""
    grey = np.random.default_rng(0).integers(0, 250, (480, 640), dtype=np.uint8)
    grey[0, 0] = 255
    for bits in (8, 10, 12, 14, 16):
        values = grey.astype(np.uint16) << (bits - 8)
        for kind in ("<u2", ">u2"):
            np.testing.assert_array_equal(grey_image(image_of_16_bits(values.astype(kind)), (640, 480)), grey)
        png = CompressedImage(format="mono16; png compressed", data=cv2.imencode(".png", values)[1].tobytes())
        np.testing.assert_array_equal(grey_image(png, (640, 480)), grey)
    assert grey_image(image_of_16_bits(np.full((480, 640), 3, "<u2")), (640, 480)).max() == 3


@pytest.mark.parametrize("size", [(320, 240), (1280, 960)])
def test_another_resolution(robot, size):
    camera = PinholeCamera(*size, size[0] / 2)
    assert robot.see(image_of(robot.rgb(BASE, camera=camera)), info_of(camera)).message == "localized"
    robot.localized(BASE)


def test_distortion_is_removed(robot):
    """An image with barrel distortion, warped from a wider pinhole."""
    wide = PinholeCamera(1280, 960, 320.0)
    info = info_of(CAMERA)
    info.d = [-0.2, 0.03, 0.001, -0.002, 0.0]
    matrix = np.array(info.k).reshape(3, 3)
    at = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(at, matrix, np.array(info.d)).reshape(480, 640, 2)
    maps = (320 * ideal + (639.5, 479.5)).astype(np.float32)
    seen = cv2.remap(robot.rgb(BASE, camera=wide), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)
    assert robot.see(image_of(seen), info).message == "localized"
    robot.localized(BASE)


def test_a_dark_image_is_lost_and_a_next_view_is_published(robot):
    status = robot.see(image_of(np.zeros((480, 640, 3), np.uint8)), info_of(CAMERA), joints=(0.5, 0.0))
    assert status.level == WARN and status.message == "lost: no pose from 0 matches with the map"
    assert robot.last("visual_localization/pose") is None
    chosen = robot.published("visual_localization/next_look")
    assert chosen.header.frame_id == "base_link"
    direction = np.array([chosen.vector.x, chosen.vector.y, chosen.vector.z])
    before = HEAD.base_from_camera(0.5, 0.0)[:, 2]
    assert direction @ before < np.cos(np.radians(29)) and np.linalg.norm(direction) == pytest.approx(1)
    localizes_again(robot)


def test_odometry_makes_a_rig_of_ambiguous_views(robot):
    """Through a small window each view alone is not confident, as much of what is expected is not found; together they are."""
    base = base_at(3.2, 2.4, 75.0)
    alone = []
    for pan in (-0.6, 0.1, 0.8, 1.5):
        rgb = robot.rgb(base, pan)
        masked = np.zeros_like(rgb)
        masked[160:320, 235:405] = rgb[160:320, 235:405]
        status = robot.see(image_of(masked), info_of(CAMERA), odometry=base_at(7.0, -2.0, 10.0), joints=(pan, 0.0))
        values = {pair.key: pair.value for pair in status.values}
        alone.append((int(values["n_views"]), json.loads(values["probabilities"])[0]))
        if alone[-1][1] >= 0.95:
            break
    n_views, probability = alone[-1]
    assert n_views >= 2 and probability >= 0.95 > alone[0][1], alone
    robot.localized(base, 0.05, 0.4)


def test_a_prior_does_no_harm_and_one_of_another_frame_is_reported(robot):
    prior = PoseWithCovarianceStamped()
    prior.header.frame_id = "odom"
    prior.pose.pose.orientation.w = 1.0
    robot.received.clear()
    robot.send("initialpose", prior)
    robot.reported("initialpose: frame is 'odom', expected 'map'")
    prior.header.frame_id = "map"
    prior.pose.pose.orientation.w = 0.0
    robot.send("initialpose", prior)
    robot.reported("initialpose: Found zero norm quaternions")
    for base in (base_at(3.0, 2.0, 0.0), base_at(5.0, 4.0, 200.0)):
        prior.pose.pose = pose_message(base)
        robot.send("initialpose", prior)
        localizes_again(robot)


@pytest.mark.parametrize(
    ("of_camera", "change", "message"),
    [
        (False, {"encoding": "yuv422"}, "image encoding 'yuv422' is not supported, only mono8, mono16, rgb8"),
        (False, {"step": 10}, "do not fit an image of 640 x 480 px rgb8, step 10"),
        (False, {"data": b"\0" * 1000}, "1000 bytes of data do not fit an image of 640 x 480 px rgb8, step 1924"),
        (True, {"k": [0.0] * 9}, "the camera is not calibrated"),
        (True, {"distortion_model": "seen_nowhere", "d": [0.1] * 5}, "'seen_nowhere' is not supported, only plumb_bob"),
        (True, {"width": 1280, "height": 960}, "the image has 640 x 480 px, but camera_info says 1280 x 960"),
        (True, {"binning_x": 2}, "binning"),
        (True, {"roi": RegionOfInterest(width=320, height=240)}, "region of interest"),
        (True, {"k": [1e-9, 0.0, 0.0, 0.0, 1e-9, 0.0, 0.0, 0.0, 1.0]}, "focal length"),
        (True, {"k": [320.0, 0.0, np.nan, 0.0, 320.0, 240.0, 0.0, 0.0, 1.0]}, "k has a number that is not finite"),
        (True, {"d": [0.1, np.inf, 0.0, 0.0, 0.0]}, "d has a number that is not finite"),
        (True, {"width": 0, "height": 0}, "camera_info says 0 x 0"),
        (True, {"d": [0.1] * 7}, "plumb_bob' has another number of coefficients than 7"),
    ],
)
def test_images_and_cameras_that_cannot_be_used(robot, of_camera, change, message):
    image = image_of(robot.rgb(BASE))
    info = info_of(CAMERA)
    for name, value in change.items():
        setattr(info if of_camera else image, name, value)
    status = robot.see(image, info)
    assert status.level == ERROR and message in status.message
    localizes_again(robot)


def test_a_region_of_interest_of_the_whole_image_is_none(robot):
    info = info_of(CAMERA)
    info.roi = RegionOfInterest(width=640, height=480)
    assert robot.see(image_of(robot.rgb(BASE)), info).message == "localized"


def test_a_head_whose_joint_states_are_missing(robot):
    """Without them the pose of the base would be wrong by the pan."""
    robot.stamp += 10.0
    robot.received.clear()
    robot.send("image", image_of(robot.rgb(BASE, 0.7)))
    robot.reported("no joint_states of pan and tilt")
    assert robot.last("visual_localization/pose") is None


def test_images_are_localized_while_odometry_is_late(robot):
    """Images every 50 ms, each newer than the odometry that has arrived."""
    image = image_of(robot.rgb(BASE))
    robot.see(image, info_of(CAMERA), odometry=base_at(0.0, 0.0, 0.0))
    robot.received.clear()
    sent = 0.0

    def two_are_localized():
        nonlocal sent
        if time.monotonic() - sent > 0.05:
            sent = time.monotonic()
            robot.stamp += 0.05
            robot.send("joint_states", JointState(name=JOINTS, position=[0.0, 0.0]))
            odom = Odometry()
            odom.pose.pose.orientation.w = 1.0
            robot.send("odom", odom, robot.stamp - 0.06)
            robot.send("image", image)
        return [name for name, _ in robot.received].count("visual_localization/pose") >= 2

    robot.wait(two_are_localized, "two poses while images arrive")
    image_key = KeyValue(key="image", value=f"{robot.stamp:.6f}")
    robot.wait(lambda: image_key in getattr(robot.status(), "values", ()), "the newest image")


def test_a_camera_unlike_the_map_s_is_reported(robot):
    camera = PinholeCamera(640, 480, 640.0)
    status = robot.see(image_of(robot.rgb(BASE, camera=camera)), info_of(camera))
    assert (
        "the focal length, relative to the width, is 2.00 times that of the map's camera" in status.message
        and status.level == WARN
    )
    robot.localized(BASE)


def test_time_that_jumps_back(robot):
    localizes_again(robot)
    jumped = robot.see(image_of(robot.rgb(BASE)), info_of(CAMERA), step_s=-50.0)
    assert jumped.message == "localized"
    robot.reported("image: time jumped back by 50.00 s; earlier images are discarded")
    robot.stamp += 100.0
    localizes_again(robot)


def test_odometry_that_contradicts_the_images(robot):
    still = base_at(0.0, 0.0, 0.0)
    robot.see(image_of(robot.rgb(BASE)), info_of(CAMERA), odometry=still)
    other = base_at(2.4, 3.1, 30.0)
    status = robot.see(image_of(robot.rgb(other)), info_of(CAMERA), odometry=still)
    assert status.level == WARN and "odometry contradicts the images by 1.06 m" in status.message
    robot.localized(other)
    moved = compose_poses(compose_poses(still, invert_poses(other)), BASE)
    assert robot.see(image_of(robot.rgb(BASE)), info_of(CAMERA), odometry=moved).message == "localized"
    broken = still.copy()
    broken[0, 3] = np.nan
    robot.see(image_of(robot.rgb(BASE)), info_of(CAMERA), odometry=broken)
    robot.reported("odom: a number is not finite")
    unset = Odometry()
    unset.pose.pose.orientation.w = 0.0
    robot.received.clear()
    robot.send("odom", unset)
    robot.reported("odom: Found zero norm quaternions")
    localizes_again(robot)
