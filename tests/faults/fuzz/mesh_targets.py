"""Meshes: binary glTF, PLY, OBJ with its materials."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from box_scenes import random_texture
from faults.fuzz.execution import Target
from scenes.test_loading import MTL, OBJ, ply, textured
from wheretolook.scenes.glb_checks import check_glb
from wheretolook.scenes.loading import load_mesh


def _texture() -> np.ndarray:
    return random_texture(np.random.default_rng(0), 4, 6)


def _glb(folder: Path) -> None:
    quad = textured(_texture(), baseColorFactor=[128, 255, 255, 255])
    quad.export(folder / "one.glb")
    scene = trimesh.Scene()
    scene.add_geometry(quad, node_name="a", transform=np.diag([2.0, -1, 1, 1]))
    scene.add_geometry(quad, node_name="b", parent_node_name="a")
    colored = trimesh.creation.box()
    colored.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    scene.add_geometry(colored)
    scene.export(folder / "several.glb")


def _ply(folder: Path) -> None:
    Image.fromarray(_texture()).save(folder / "t.png")
    uvs = ["6 0 0 1 0 1 1", "6 0.5 0 1 1 0 1"]
    corners = {"face_properties": "property list uchar float texcoord", "face_values": uvs}
    (folder / "corners.ply").write_text(ply(**corners, comment="comment TextureFile t.png"))
    rgb = "\n".join(f"property uchar {name}" for name in ("red", "green", "blue"))
    (folder / "colors.ply").write_text(ply(rgb, ["1 2 3"] * 4))
    (folder / "faces.ply").write_text(ply(face_properties=rgb, face_values=["1 2 3"] * 2))
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    box.export(folder / "binary.ply")


def _obj(folder: Path) -> None:
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.mtl").write_text(MTL)
    Image.fromarray(_texture()).save(folder / "my texture.png")


def _read_obj(path: Path) -> None:
    load_mesh(path.with_name("a.obj"))


def _trees(folder: Path) -> None:
    _glb(folder)
    for name in ("one", "several"):
        data = (folder / f"{name}.glb").read_bytes()
        (folder / f"{name}.json").write_bytes(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]].strip())


def _check_tree(text: str) -> None:
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError):
        return
    check_glb(tree, Path("a.glb"), 4096)


TARGETS = (
    Target("glb-checks", _trees, ("one.json", "several.json"), _check_tree, in_memory=True),
    Target("glb", _glb, ("one.glb", "several.glb"), load_mesh),
    Target(
        "ply",
        _ply,
        ("corners.ply", "colors.ply", "faces.ply", "binary.ply", "t.png"),
        lambda path: load_mesh(path.with_name("corners.ply") if path.suffix == ".png" else path),
    ),
    Target("obj", _obj, ("a.obj", "a.mtl", "my texture.png"), _read_obj),
)
