"""A room with a wall and a cupboard in it, and exact depth images of it."""

import numpy as np

from box_scenes import box_quads, quads_mesh, random_texture
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.tsdf import DepthImage
from wheretolook.rendering.warp_renderer import WarpRenderer

ROOM = np.array([4.0, 3.0, 2.5])
CUPBOARD = np.array([[0.0, 2.2, 0.0], [1.2, 3.0, 1.6]])
CAMERA = PinholeCamera(320, 240, 160.0)


def room(wall_m=0.1):
    """A room with a wall, open at one end, across it, and a cupboard; the wall may have no thickness."""
    wall = box_quads((2 - wall_m / 2, 0, 0), (2 + wall_m / 2, 2, 2.5))
    if wall_m == 0:
        wall = np.array([[[2, 0, 0], [2, 2, 0], [2, 2, 2.5], [2, 0, 2.5]]], dtype=np.float64)
    quads = np.concatenate([box_quads((0, 0, 0), ROOM, inward=True), wall, box_quads(*CUPBOARD)])
    return quads_mesh(quads, [random_texture(np.random.default_rng(0), 4, 4)])


def free_points(rng, n, clearance_m=0.25):
    """Random points in the room, clear of the wall and outside the cupboard."""
    points = rng.uniform(clearance_m, ROOM - clearance_m, (3 * n, 3))
    in_wall = (np.abs(points[:, 0] - 2) < clearance_m) & (points[:, 1] < 2 + clearance_m)
    in_cupboard = ((points > CUPBOARD[0] - clearance_m) & (points < CUPBOARD[1] + clearance_m)).all(1)
    return points[~in_wall & ~in_cupboard][:n]


def depth_images(mesh, seed, n, camera=CAMERA):
    """Exact depth images from random free places in random, mostly level directions."""
    rng = np.random.default_rng(seed)
    poses = poses_looking_along(free_points(rng, n), rng.normal(size=(n, 3)) * (1, 1, 0.5))
    depth_m = WarpRenderer(mesh, method="rays").render(camera, poses).depth_m
    return [DepthImage(image, camera, pose) for image, pose in zip(depth_m, poses, strict=True)]
