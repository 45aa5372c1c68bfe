"""Corrupt and hostile PLY, OBJ and GLB files and textures give a typed error that names them, with little memory."""

from __future__ import annotations

import base64
import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import wheretolook
from box_scenes import random_texture
from scenes.test_loading import textured
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils import memory
from wheretolook.utils.errors import SceneError

CUBE = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
FACES = [(0, 1, 2), (3, 4, 5), (1, 6, 7)]


def ply(n_vertices: object, n_faces: object, form: str = "binary_little_endian", comment: str = "") -> bytes:
    """A PLY file of eight coloured vertices and three triangles, whatever its header counts."""
    head = f"ply\nformat {form} 1.0\n{comment}element vertex {n_vertices}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue"))
    head += f"element face {n_faces}\nproperty list uchar int vertex_indices\nend_header\n"
    if form == "ascii":
        lines = [f"{x} {y} {z} 1 2 3" for x, y, z in CUBE] + [f"3 {a} {b} {c}" for a, b, c in FACES]
        return (head + "\n".join(lines) + "\n").encode()
    body = b"".join(struct.pack("<3f3B", *point, 1, 2, 3) for point in CUBE)
    return head.encode() + body + b"".join(struct.pack("<B3i", 3, *face) for face in FACES)


def obj(extra: str = "", faces: str = "f 1/1 2/1 3/1\nf 4/1 5/1 6/1\nf 2/1 7/1 8/1\n") -> bytes:
    vertices = "".join(f"v {x} {y} {z} 1 0 0\n" for x, y, z in CUBE)
    return f"{extra}{vertices}vt 0.1 0.1\n{faces}".encode()


def png(width: int = 4, height: int = 4) -> bytes:
    """A black image of a bit a pixel, of any size, which Pillow is not asked to make."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj()
    rows = b"".join(packer.compress(bytes((width + 7) // 8 + 1)) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def uri(data: bytes, kind: str = "image/png") -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def glb(image: str, embedded: bool = False, count: int = 8, room: int = 96) -> bytes:
    """A binary glTF whose one image is a URI, and on request its buffer too."""
    data = b"".join(struct.pack("<3f", *point) for point in CUBE)
    data += (
        struct.pack("<9H", *(corner for face in FACES for corner in face)) + bytes(2) + struct.pack("<16f", *[0.1] * 16)
    )
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": image}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 9, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": count, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": begin, "byteLength": length}
            for begin, length in ((0, room), (96, 18), (116, 64))
        ],
        "buffers": [{"byteLength": len(data), **({"uri": uri(data, "application/octet-stream")} if embedded else {})}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    rest = b"" if embedded else struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


MTL = b"newmtl a\nmap_Kd picture.png\n"
USING = "mtllib a.mtl\nusemtl a\n"
WHOLE = {
    "a.ply": {"a.ply": ply(8, 3)},
    "b.ply": {"b.ply": ply(8, 3, "ascii")},
    "a.obj": {"a.obj": obj(USING), "a.mtl": MTL, "picture.png": png()},
    "a.glb": {"a.glb": glb(uri(png()))},
    "embedded.glb": {"embedded.glb": glb(uri(png()), embedded=True)},
    "sibling.glb": {"sibling.glb": glb("picture.png"), "picture.png": png()},
}
BROKEN = {
    "more vertices than bytes": {"a.ply": ply(300_000_000, 3)},
    "fewer than none": {"a.ply": ply(-1, 3)},
    "more vertices than lines": {"a.ply": ply(10**9, 3, "ascii")},
    "a header without end": {"a.ply": b"ply\nformat ascii 1.0\n" + b"comment x\n" * 300_000},
    "a vertex that is not there": {"a.obj": obj(faces="f 1 2 99\n")},
    "too many parts": {"a.obj": obj(faces="".join(f"usemtl m{i}\nf 1 2 3\n" for i in range(20_000)))},
    "a library that is a device": {"a.obj": obj("mtllib /dev/zero\n")},
    "a bomb": {"a.obj": obj(USING), "a.mtl": MTL, "picture.png": png(60_000, 3_000)},
    "a texture that is a device": {"a.obj": obj(USING), "a.mtl": b"newmtl a\nmap_Kd /dev/zero\n"},
    "a PLY's texture": {"a.ply": ply(8, 3, comment="comment TextureFile p.png\n"), "p.png": b"no"},
    "no image in a URI": {"a.glb": glb(uri(b"junk"))},
    "half an image in a URI": {"a.glb": glb(uri(png(400, 400)[:-40]))},
    "a bomb in a URI": {"a.glb": glb(uri(png(60_000, 3_000)))},
    "no base64": {"a.glb": glb("data:image/png;base64,###")},
    "a URI that leads out": {"a.glb": glb("/etc/hostname")},
    "a URI of nothing": {"a.glb": glb("missing.png")},
    "a URI of the net": {"a.glb": glb("http://127.0.0.1:9/a.png")},
    "an embedded buffer that lies": {"a.glb": glb(uri(png()), True, 300_000_000, 10**10)},
}


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder / next(iter(files))


@pytest.mark.parametrize("name", WHOLE)
def test_whole_files_are_read(name: str, tmp_path: Path) -> None:
    mesh = load_mesh(write(tmp_path, WHOLE[name]))
    assert len(mesh.triangles) == 3
    assert mesh.vertex_colors is not None or mesh.textures[0].shape == (4, 4, 3)


@pytest.mark.parametrize("name", BROKEN)
def test_invalid_files_are_rejected_by_name(name: str, tmp_path: Path) -> None:
    files = BROKEN[name]
    path = write(tmp_path, files)
    with pytest.raises(SceneError) as caught:
        load_mesh(path, colored=False)
    assert Path(caught.value.path or "").name in files and caught.value.fix


def test_textures_that_are_too_large_together_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    materials = ""
    uses = ""
    for number in range(4):
        Image.new("L", (100, 100), number).save(tmp_path / f"{number}.png")
        materials = f"{materials}newmtl m{number}\nmap_Kd {number}.png\n"
        uses = f"{uses}usemtl m{number}\nf 1/1 2/1 3/1\n"
    path = write(
        tmp_path, {"a.obj": obj("mtllib a.mtl\n", uses + "usemtl m0\nf 1/1 4/1 8/1\n"), "a.mtl": materials.encode()}
    )
    assert len(load_mesh(path).textures) == 4
    monkeypatch.setattr(memory, "available_bytes", lambda: 300_000)
    with pytest.raises(SceneError):
        load_mesh(path)


@pytest.fixture
def whole(tmp_path):
    textured(random_texture(np.random.default_rng(0), 4, 6)).export(tmp_path / "a.glb")
    return tmp_path / "a.glb"


def rewrite(path, change):
    content = path.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    tree = change(json.loads(content[20 : 20 + length]))
    chunk = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    chunk += b" " * (-len(chunk) % 4)
    rest = content[20 + length :]
    header = struct.pack("<4sIIII", b"glTF", 2, 20 + len(chunk) + len(rest), len(chunk), 0x4E4F534A)
    path.write_bytes(header + chunk + rest)


def accessor(count, view):
    def change(tree):
        tree["accessors"][0]["count"] = count
        if not view:
            tree["accessors"][0].pop("bufferView")
        return tree

    return change


def nested(tree):
    n = 100_000
    tree["nodes"] = [{"children": [i + 1]} for i in range(n)] + [{"mesh": 0}]
    tree["scenes"] = [{"nodes": [0]}]
    return tree


def few_uvs(tree):
    at = tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    tree["accessors"][at]["count"] = 2
    return tree


CHANGES = [accessor(count, view) for count in (0, -1, 300_000_000, None) for view in (False, True)]
CHANGES += [nested, few_uvs, lambda tree: None, lambda tree: {**tree, "accessors": None}, lambda tree: b"[" * 100_000]


@pytest.mark.parametrize("change", CHANGES)
def test_invalid_trees_are_rejected(whole, change):
    rewrite(whole, change)
    with pytest.raises(SceneError) as caught:
        load_mesh(whole)
    assert caught.value.path == whole


def test_a_texture_that_cannot_be_opened_is_not_omitted(whole):
    content = whole.read_bytes()
    assert content.count(b"\x89PNG") == 1
    whole.write_bytes(content.replace(b"\x89PNG", b"\x00PNG"))
    with pytest.raises(SceneError):
        load_mesh(whole)


FLIPS = """
import random, resource, sys, warnings
from pathlib import Path
import numpy as np
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import SceneError
resource.setrlimit(resource.RLIMIT_AS, (4 << 30,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
warnings.simplefilter("ignore")
draw, path, said = random.Random(21), Path(sys.argv[1]), [0, 0]
whole = path.read_bytes()
for _ in range(400):
    bit = draw.randrange(8 * len(whole))
    flipped = bytearray(whole)
    flipped[bit // 8] ^= 1 << bit % 8
    path.write_bytes(flipped)
    try:
        assert np.isfinite(load_mesh(path).vertices).all()
        said[0] += 1
    except SceneError as error:
        assert Path(error.path) == path, (bit, error)
        said[1] += 1
    except Exception as error:
        raise AssertionError(bit) from error
print(*said)
"""


def test_flipped_bits_are_typed_errors_or_numbers(whole):
    env = {**os.environ, "PYTHONPATH": str(Path(wheretolook.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", FLIPS, str(whole)], capture_output=True, text=True, timeout=120, env=env
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert min(map(int, done.stdout.split())) > 50
