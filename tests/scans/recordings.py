"""RGB-D recordings of a room of boxes, rendered by the project's own renderer, so that everything is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from box_scenes import box_quads, quads_mesh
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import invert_poses, poses_looking_along, quaternion_from_rotation
from wheretolook.rendering.warp_renderer import WarpRenderer

WIDTH = 160
HEIGHT = 120
COLOR = PinholeCamera(WIDTH, HEIGHT, 525 / 4)  # the nominal cameras of both layouts, at a quarter of their size
DEPTH = PinholeCamera(WIDTH, HEIGHT, 585 / 4)
BASELINE_M = np.array([-0.025, 0, 0])  # of the depth camera in the colour camera's frame
LOW = (0.0, 0.0, 0.0)
HIGH = (3.6, 3.0, 2.4)


def room():
    """A room with a cabinet, z up, seen from inside; smooth random textures."""
    rng = np.random.default_rng(0)
    quads = np.concatenate([box_quads(LOW, HIGH, inward=True), box_quads((2.6, 0.1, 0.0), (3.4, 1.1, 1.2))])
    textures = [
        cv2.resize(rng.integers(30, 226, (64, 64, 3)).astype(np.uint8), (256, 256), interpolation=cv2.INTER_CUBIC)
        for _ in quads
    ]
    return quads_mesh(quads, textures)


def walk(n=60):
    """Poses cam_from_world (n, 3, 4): around the room looking outwards and up, then further out, inwards and down."""
    turn = np.linspace(0, 4 * np.pi, n, endpoint=False)
    inwards = turn >= 2 * np.pi
    outwards = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    where = np.array([1.7, 1.6, 1.3]) + np.where(inwards, 0.9, 0.35)[:, None] * outwards
    where[:, 2] += 0.2 * np.sin(3 * turn)
    pitch = np.where(inwards, -0.5, 0.2)
    along = np.where(inwards, -1, 1)[:, None] * outwards * np.cos(pitch)[:, None] + np.sin(pitch)[:, None] * (0, 0, 1)
    return poses_looking_along(where, along)


def turned(poses, world):
    """Poses in a world that a rotation (3, 3) takes to the room's."""
    return np.concatenate([poses[:, :, :3] @ world, poses[:, :, 3:]], axis=2)


def write_seven_scenes(folder: Path, mesh, poses, world=np.eye(3), depth_scale=1000.0, poses_scale=1.0):
    """A recording in the layout of 7-Scenes. The poses (F, 3, 4) in the room are of the colour camera."""
    folder.mkdir(parents=True, exist_ok=True)
    renderer = WarpRenderer(mesh)
    of_depth = poses.copy()
    of_depth[:, :, 3] -= BASELINE_M
    rgb = renderer.render(COLOR, poses).rgb
    depth = renderer.render(DEPTH, of_depth).depth_m
    for i, pose in enumerate(invert_poses(turned(of_depth, world))):
        cv2.imwrite(str(folder / f"frame-{i:06d}.color.png"), rgb[i, :, :, ::-1])
        units = np.where(depth[i] > 0, np.rint(depth[i] * depth_scale), 65535)
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), units.astype(np.uint16))
        pose[:, 3] *= poses_scale
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", np.vstack([pose, (0, 0, 0, 1)]))
    return rgb


def write_tum(folder: Path, mesh, poses):
    """A recording in the layout of the TUM RGB-D benchmark: registered depth, 5000 units a metre."""
    rendered = WarpRenderer(mesh).render(COLOR, poses)
    lists = {name: ["# a comment"] for name in ("rgb", "depth", "groundtruth")}
    for i, pose in enumerate(invert_poses(poses)):
        time = 1305031102.1758 + i / 30
        for name, image in (("rgb", rendered.rgb[i, :, :, ::-1]), ("depth", rendered.depth_m[i] * 5000)):
            (folder / name).mkdir(parents=True, exist_ok=True)
            file = f"{name}/{time:.6f}.png"
            cv2.imwrite(str(folder / file), image if name == "rgb" else np.rint(image).astype(np.uint16))
            lists[name].append(f"{time + 0.003 * (name == 'depth'):.6f} {file}")
        w, x, y, z = quaternion_from_rotation(pose[:, :3])
        values = [time - 0.004, *pose[:, 3], x, y, z, w]
        lists["groundtruth"].append(" ".join(f"{value:.6f}" for value in values))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return rendered.rgb
