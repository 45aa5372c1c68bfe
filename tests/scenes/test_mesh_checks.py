"""Corrupt and hostile PLY, OBJ and GLB files and textures give a typed error that names them, with little memory."""

import base64
import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from box_scenes import random_texture
from scenes.test_loading import FACES, VERTICES, textured
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils import devices as memory
from wheretolook.utils.errors import SceneError


def png(height=4, width=6):
    buffer = io.BytesIO()
    Image.fromarray(random_texture(np.random.default_rng(0), height, width)).save(buffer, "png")
    return buffer.getvalue()


def huge_png():
    """A small image whose header says that it has 180 million pixels."""
    head = struct.pack(">4sIIBBBBB", b"IHDR", 60_000, 3_000, 8, 2, 0, 0, 0)
    return png()[:12] + head + struct.pack(">I", zlib.crc32(head)) + png()[33:]


def uri(data, kind="image/png"):
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def obj(head="", faces="f 1/1 2/1 3/1\n"):
    return f"{head}v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nv 0 0 1 1 0 0\nvt 0.1 0.1\n{faces}".encode()


USING = "mtllib a.mtl\nusemtl a\n"
BINARY_PLY = trimesh.Trimesh(VERTICES, FACES, process=False).export(file_type="ply")
BROKEN = {
    "an unknown format": {"a.stl": b"solid"},
    **{f"an empty {suffix}": {f"a.{suffix}": b""} for suffix in ("glb", "ply", "obj")},
    "garbage in GLB": {"a.glb": b"garbage that is longer than a header"},
    "points without faces": {"a.obj": b"v 0 0 0\nv 1 1 1\n"},
    "more vertices than bytes": {"a.ply": BINARY_PLY.replace(b"vertex 4", b"vertex 300000000")},
    "a header without end": {"a.ply": b"ply\nformat ascii 1.0\n" + b"comment x\n" * 300_000},
    "more vertices than lines": {
        "a.ply": trimesh.Trimesh(VERTICES, FACES, process=False)
        .export(file_type="ply", encoding="ascii")
        .replace(b"vertex 4", b"vertex 300000000")
    },
    "a text that is cut": {
        "a.ply": trimesh.Trimesh(VERTICES, FACES, process=False)
        .export(file_type="ply", encoding="ascii")
        .rpartition(b"\n3 ")[0]
    },
    "a vertex out of range": {"a.obj": obj(faces="f 1 2 99\n")},
    "a vertex before the first": {"a.obj": obj(faces="f 1 2 -9\n")},
    "too many parts": {"a.obj": obj(faces="".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(20_000)))},
    "a library that is a device": {"a.obj": obj("mtllib /dev/zero\n")},
    "a texture that is a device": {"a.obj": obj(USING), "a.mtl": b"newmtl a\nmap_Kd /dev/zero\n"},
    "a huge texture": {"a.obj": obj(USING), "a.mtl": b"newmtl a\nmap_Kd picture.png\n", "picture.png": huge_png()},
}


@pytest.mark.parametrize("name", BROKEN)
def test_invalid_files_are_rejected_by_name(name, tmp_path):
    files = BROKEN[name]
    for file, content in files.items():
        (tmp_path / file).write_bytes(content)
    with pytest.raises(SceneError) as caught:
        load_mesh(tmp_path / next(iter(files)), colored=False)
    assert Path(caught.value.path or "").name in files


def test_textures_beyond_the_memory_are_rejected(tmp_path, monkeypatch):
    materials = ""
    faces = ""
    for number in range(4):
        Image.new("L", (100, 100), number).save(tmp_path / f"{number}.png")
        materials += f"newmtl m{number}\nmap_Kd {number}.png\n"
        faces += f"usemtl m{number}\nf 1/1 2/1 3/1\nf 1/1 2/1 4/1\n"
    (tmp_path / "a.obj").write_bytes(obj("mtllib a.mtl\n", faces))
    (tmp_path / "a.mtl").write_text(materials)
    assert len(load_mesh(tmp_path / "a.obj").textures) == 4
    monkeypatch.setattr(memory, "available_bytes", lambda: 300_000)
    with pytest.raises(SceneError):
        load_mesh(tmp_path / "a.obj")


@pytest.fixture
def whole(tmp_path):
    textured(random_texture(np.random.default_rng(0), 4, 6)).export(tmp_path / "a.glb")
    return tmp_path / "a.glb"


def rewrite(path, change):
    """Replace the JSON of a binary glTF by change(tree, buffer); without its buffer where the JSON holds that."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    rest = content[20 + length :]
    tree = change(json.loads(content[20 : 20 + length]), rest[8:])
    chunk = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    chunk += b" " * (-len(chunk) % 4)
    if b"octet-stream" in chunk:
        rest = b""
    path.write_bytes(
        struct.pack("<4sIIII", b"glTF", 2, 20 + len(chunk) + len(rest), len(chunk), 0x4E4F534A) + chunk + rest
    )


def with_image(address):
    return lambda tree, _: {**tree, "images": [{"uri": address}]}


def with_accessor(**fields):
    return lambda tree, _: {**tree, "accessors": [{**tree["accessors"][0], **fields}, *tree["accessors"][1:]]}


def embedded(tree, buffer):
    return {**tree, "buffers": [{"byteLength": len(buffer), "uri": uri(buffer, "application/octet-stream")}]}


def without_data(tree, _):
    """trimesh would fill the memory with zeros."""
    accessor = {name: value for name, value in tree["accessors"][0].items() if name != "bufferView"}
    return {**tree, "accessors": [{**accessor, "count": 300_000_000}, *tree["accessors"][1:]]}


def with_nodes(n, n_primitives=1):
    """Nodes that share a mesh of parts; trimesh would take minutes for 100,000."""

    def change(tree, _):
        primitives = tree["meshes"][0]["primitives"] * n_primitives
        nodes = [{"mesh": 0} for _ in range(n)]
        return {**tree, "meshes": [{"primitives": primitives}], "nodes": nodes, "scenes": [{"nodes": [*range(n)]}]}

    return change


def few_uvs(tree, _):
    at = tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    tree["accessors"][at]["count"] = 2
    return tree


def quantized(kind):
    """Positions, which a node scales back, and texture coordinates become normalized integers in rows of four."""

    def change(tree, buffer):
        (primitive,) = tree["meshes"][0]["primitives"]
        for name, columns in (("POSITION", 3), ("TEXCOORD_0", 2)):
            accessor = tree["accessors"][primitive["attributes"][name]]
            start = tree["bufferViews"][accessor["bufferView"]].get("byteOffset", 0) + accessor.get("byteOffset", 0)
            values = np.frombuffer(buffer, "<f4", accessor["count"] * columns, start).reshape(-1, columns)
            stored = np.zeros((len(values), 4), kind)
            stored[:, :columns] = np.rint(values / {3: 4, 2: 1}[columns] * np.iinfo(kind).max)
            row = {"byteStride": 4 * stored.itemsize, "byteLength": stored.nbytes, "byteOffset": len(buffer)}
            buffer += stored.tobytes()
            number = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123}[kind]
            accessor |= {"bufferView": len(tree["bufferViews"]), "byteOffset": 0}
            accessor |= {"componentType": number, "normalized": True}
            tree["bufferViews"].append({"buffer": 0, **row})
        tree["nodes"] = [{"mesh": 0, "scale": [4, 4, 4]}]
        tree["scenes"] = [{"nodes": [0]}]
        tree["extensionsRequired"] = tree["extensionsUsed"] = ["KHR_mesh_quantization"]
        return embedded(tree, buffer)

    return change


@pytest.mark.parametrize("kind", ["int8", "uint8", "int16", "uint16"])
def test_normalized_integers_are_fractions_of_the_largest(whole, kind):
    expected = load_mesh(whole)
    rewrite(whole, quantized(kind))
    mesh = load_mesh(whole)
    step = 1 / np.iinfo(kind).max
    np.testing.assert_allclose(mesh.vertices, expected.vertices, atol=2.01 * step)
    np.testing.assert_allclose(mesh.corner_uvs, expected.corner_uvs, atol=0.51 * step + 1e-6)
    np.testing.assert_array_equal(mesh.textures[0], expected.textures[0])


@pytest.mark.parametrize("kind", [None, "uint16"])
def test_texture_coordinates_are_transformed(whole, kind):
    """Scaled, turned by a quarter from v to u, and moved (KHR_texture_transform)."""
    u, v = load_mesh(whole).corner_uvs.reshape(-1, 2).T

    def change(tree, buffer):
        texture = tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        turn = {"offset": [0.25, 0.5], "rotation": np.pi / 2, "scale": [0.5, 0.2]}
        texture["extensions"] = {"KHR_texture_transform": turn}
        return quantized(kind)(tree, buffer) if kind else tree

    rewrite(whole, change)
    found = load_mesh(whole).corner_uvs.reshape(-1, 2)
    np.testing.assert_allclose(found, np.column_stack([0.25 + 0.2 * v, 0.5 - 0.5 * u]), atol=1e-5)


def compressed(tree, _):
    """As Draco leaves a file: accessors without data, and the extension with that."""
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    position = tree["accessors"][primitive["attributes"]["POSITION"]]
    del position["bufferView"]
    return tree


def with_extension(name, required=True):
    return lambda tree, _: {**tree, "extensionsUsed": [name]} | ({"extensionsRequired": [name]} if required else {})


def as_fans(tree, _):
    tree["meshes"][0]["primitives"][0]["mode"] = 6
    return tree


@pytest.mark.parametrize(
    ("change", "value"),
    [
        (compressed, "KHR_draco_mesh_compression"),
        (with_extension("EXT_meshopt_compression"), "EXT_meshopt_compression"),
        (with_extension("EXT_mesh_gpu_instancing", required=False), "EXT_mesh_gpu_instancing"),
        (as_fans, "triangle fans"),
        (lambda tree, _: {**tree, "nodes": [{"mesh": 0, "skin": 0}]}, "skins"),
        (lambda tree, _: {**tree, "meshes": [{**tree["meshes"][0], "weights": [0.0, 0.5]}]}, "morph targets"),
    ],
)
def test_geometry_that_is_not_read_is_named(whole, change, value):
    rewrite(whole, change)
    with pytest.raises(SceneError) as caught:
        load_mesh(whole)
    assert caught.value.value == value


def test_indices_of_obj_may_count_back_from_their_line(tmp_path):
    (tmp_path / "a.obj").write_bytes(
        obj(faces="vt 0 0\nf -4/-2 -3/-1 -2/1\nv 2 0 1 1 0 0\nf -5/-1 4/-1 -1/-1\nf 1 2 -1\n")
    )
    (tmp_path / "b.obj").write_bytes(obj(faces="vt 0 0\nv 2 0 1 1 0 0\nf 1/1 2/2 3/1\nf 1/2 4/2 5/2\nf 1 2 5\n"))
    found, expected = (load_mesh(tmp_path / name) for name in ("a.obj", "b.obj"))
    np.testing.assert_array_equal(found.vertices[found.triangles], expected.vertices[expected.triangles])
    assert len(found.triangles) == 3


@pytest.mark.parametrize("change", [with_image(uri(png())), with_image("picture.png"), embedded])
def test_images_and_buffers_at_a_uri_are_read(whole, change):
    expected = load_mesh(whole)
    (whole.parent / "picture.png").write_bytes(png())
    rewrite(whole, change)
    mesh = load_mesh(whole)
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(mesh.textures[0], expected.textures[0])


ADDRESSES = [uri(b"junk"), uri(png(400, 400)[:-40]), uri(huge_png()), "data:image/png;base64,###"]
ADDRESSES += ["/etc/hostname", "missing.png", "http://127.0.0.1:9/a.png"]
CHANGES = [with_image(address) for address in ADDRESSES]
CHANGES += [with_accessor(count=count) for count in (0, -1, 300_000_000, None)]
CHANGES += [without_data, few_uvs, with_nodes(1, 100_000), with_nodes(100_000), with_nodes(20_000, 20_000)]
CHANGES += [lambda tree, _: None, lambda tree, _: {**tree, "accessors": None}, lambda tree, _: b"[" * 100_000]


@pytest.mark.parametrize("change", CHANGES)
def test_invalid_trees_are_rejected(whole, change):
    rewrite(whole, change)
    with pytest.raises(SceneError):
        load_mesh(whole)


@pytest.mark.parametrize("vertices", [VERTICES * (1, 1, 0), 0 * VERTICES, np.where(VERTICES == 3, np.nan, VERTICES)])
def test_degenerate_geometry_is_rejected(tmp_path, vertices):
    textured(random_texture(np.random.default_rng(0), 4, 6), vertices).export(tmp_path / "a.glb")
    with pytest.raises(SceneError):
        load_mesh(tmp_path / "a.glb")
