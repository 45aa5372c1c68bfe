"""Read textured meshes from GLB, PLY and OBJ files, and write them as GLB."""

from __future__ import annotations

import base64
import hashlib
import io
import itertools
import json
import math
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.similarity import local_origin
from wheretolook.utils.devices import fitting
from wheretolook.utils.errors import SceneError, check_choice, check_range
from wheretolook.utils.files import image_size, max_expanded_bytes, parse_json_object, read_text, write_bytes

# Rotations that turn the named axis of a file into the world's z axis.
_Z_UP_FROM = {
    "x": [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    "-x": [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
}
_WHITE = np.full((1, 1, 3), 255, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class _Part:
    """One geometry of a file, in the file's coordinates."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    uvs: NDArray[np.float64] | None  # (V, 2), v down
    texture: NDArray[np.uint8]  # `_WHITE` if the file defines none
    colors: NDArray[np.uint8] | None  # (V, 3)


def load_mesh(path: str | PathLike[str], up: str = "z", colored: bool = True) -> TexturedMesh:
    """Read a scene in metres from a file or a Habitat-Matterport folder.

    Each material of the file becomes a texture; one without an image becomes a texture of one pixel in its colour.
    Vertex colours, which count as sRGB, multiply the texture. Triangles without area are dropped.

    Takes a .glb, .ply (with texture coordinates and a `TextureFile`, or coloured vertices or faces) or .obj file (with
    its .mtl), or a folder `<id>-<name>` that holds `<name>.glb`, as in the Habitat-Matterport dataset. `up` is the axis
    of the file that points up: "z", "y", "x" or one of these with a minus sign. glTF prescribes y, but many scans are z
    up nevertheless; with the wrong axis a scene has no free space. A mesh that is not rendered need not be `colored`.

    Raises SceneError if the file is missing, unreadable, empty, flat, not finite, without any texture or colour, or
    names a texture that is missing or in an unsupported format; ConfigError if `up` is not an axis.
    """
    check_choice("up axis", up, _Z_UP_FROM)
    file = _mesh_file(Path(path))
    _check_file(file)
    try:
        corrected = {".glb": _with_all_applied, ".obj": _with_positive_indices}.get(file.suffix.lower())
        changed = corrected(file) if corrected else None
        source, kind = changed or (file.open("rb"), file.suffix[1:].lower())
        with source:
            resolver = trimesh.resolvers.FilePathResolver(str(file))
            scene = trimesh.load_scene(source, file_type=kind, resolver=resolver, process=False)
        parts = list(_parts(scene))
    except Exception as error:  # trimesh's parsers raise errors of many kinds
        raise SceneError("the mesh cannot be read", path=file, value=str(error), fix="Check the file") from error
    if not parts:
        raise SceneError("the file has no triangles", path=file, fix="Export the scene as a triangle mesh")
    if colored and all(part.texture is _WHITE and part.colors is None for part in parts):
        fix = "Export it with its textures; a map cannot be built from a plain surface"
        raise SceneError("the mesh has no texture and no colours", path=file, fix=fix)
    return _cleaned(_merge(parts, np.array(_Z_UP_FROM[up], dtype=np.float64)), file)


def save_glb(mesh: TexturedMesh, path: str | PathLike[str], jpeg_quality: int = 90) -> None:
    """Write a mesh as a binary glTF file with JPEG textures, unlit and double sided, in its own z-up coordinates.

    Positions and texture coordinates keep their float32 values (v to within rounding, since it is flipped twice); nodes
    hold the mesh's origin, in double precision. Triangles are grouped by texture, and corners with the same position
    and texture coordinates share a vertex. The file is replaced atomically. Raises ConfigError if the quality is not in
    1 to 100.
    """
    write_bytes(Path(path), glb_bytes(mesh, jpeg_quality))


def glb_bytes(mesh: TexturedMesh, jpeg_quality: int = 90) -> bytes:
    """The content of the file that `save_glb` writes."""
    check_range("JPEG quality", jpeg_quality, 1, 100)
    scene = trimesh.Scene()
    for index, texture in enumerate(mesh.textures):
        faces = np.flatnonzero(mesh.triangle_texture == index)
        if len(faces):
            part = _geometry(mesh, faces, _EncodedJpeg(texture, jpeg_quality))
            at = trimesh.transformations.translation_matrix(mesh.origin) if mesh.origin.any() else None
            scene.add_geometry(part, node_name=f"part_{index}", transform=at)
    return bytes(trimesh.exchange.gltf.export_glb(scene, tree_postprocessor=_mark_unlit))


def _mesh_file(path: Path) -> Path:
    """The mesh file of a path, which may be a Habitat-Matterport folder. Raises SceneError if there is none."""
    file = path / f"{path.name.partition('-')[2]}.glb" if path.is_dir() else path
    if not file.is_file() or file.suffix.lower() not in (".glb", ".ply", ".obj"):
        fix = "Give an existing file .glb, .ply, .obj, or a Habitat-Matterport folder <id>-<name>"
        raise SceneError("there is no mesh", path=file, fix=fix)
    return file


def _check_file(path: Path) -> None:
    """Raise SceneError for a texture that is missing, unreadable or too large, or for parts that do not fit into memory.

    trimesh omits textures that it cannot read, or replaces them by a grey placeholder, without an error.
    """
    list_textures = {".glb": _glb_textures, ".ply": _ply_textures, ".obj": _obj_textures}[path.suffix.lower()]
    try:
        n_pixels = sum(math.prod(image_size(texture)) for texture in dict.fromkeys(list_textures(path)))
    except (ValueError, OSError, KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        problem = f"the file or a texture is truncated, corrupt or too large: {type(error).__name__}: {error}"
        raise SceneError(problem, path=path, fix="Copy or export the scene again.") from error
    limit = fitting(11)  # bytes of a pixel while it is read
    if n_pixels > limit:
        fix = f"Scale them down: {limit:,} pixels fit into memory."
        raise SceneError("the textures are too large together", path=path, value=f"{n_pixels:,} pixels", fix=fix)


def _sibling(path: Path, name: str) -> Path:
    """A file that a mesh names. Raises SceneError unless it exists, in the mesh's folder or a subfolder."""
    file = path.parent / name
    if not Path(os.path.normpath(file)).is_relative_to(os.path.normpath(path.parent)) or not file.is_file():
        fix = "Put it into the mesh's folder, under the name that the mesh gives it."
        raise SceneError("a file of the scene is missing, or outside of its folder", path=path, value=name, fix=fix)
    return file


def _glb_textures(path: Path) -> Iterator[Path | bytes]:
    """Images of a binary glTF 2.0 file (specification, section 4.4): sibling files, or their content.

    Raises ValueError for what makes trimesh run for minutes or fill the memory: many parts, and accessors without data;
    and SceneError for what it leaves out: compression, instances, sparse positions and fans of triangles.
    """
    tree, content = _read_glb(path)
    _check_readable(tree, path)
    accessors = tree.get("accessors", [])
    for accessor in accessors:
        if "bufferView" not in accessor and accessor["count"] > max_expanded_bytes(len(content)) // 64:  # 4 x 4 numbers
            raise ValueError(f"an accessor without data has {accessor['count']} elements")
    meshes = [mesh["primitives"] for mesh in tree.get("meshes", [])]
    shown = [meshes[node["mesh"]] for node in tree.get("nodes", []) if "mesh" in node]
    if sum(map(len, meshes + shown)) > 40_000:  # trimesh takes 0.3 ms for each
        raise ValueError("its meshes and nodes have more than 40,000 parts; join them")
    drawn = [part.get("indices", part["attributes"]["POSITION"]) for part in itertools.chain.from_iterable(shown)]
    n_corners = sum(accessors[at]["count"] for at in drawn)
    if n_corners > fitting(200):  # bytes of a corner while it is read
        raise ValueError(f"its nodes have {n_corners // 3:,} triangles together")
    buffers = _buffers(tree, content, path)
    for image in tree.get("images", []):
        if "bufferView" in image:
            view = tree["bufferViews"][image["bufferView"]]
            start = view.get("byteOffset", 0)
            yield buffers[view["buffer"]][start : start + view["byteLength"]]
        else:
            yield _at_uri(image["uri"], path)


def _read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON object of a binary glTF file, and its own buffer."""
    content = path.read_bytes()
    json_length, _ = struct.unpack_from("<II", content, 12)
    return parse_json_object(content[20 : 20 + json_length].decode()), content[28 + json_length :]


def _primitives(tree: dict[str, Any]) -> list[dict[str, Any]]:
    return [primitive for mesh in tree.get("meshes", []) for primitive in mesh["primitives"]]


def _buffers(tree: dict[str, Any], content: bytes, path: Path) -> list[bytes]:
    sources = [_at_uri(one["uri"], path) if "uri" in one else content for one in tree.get("buffers", [])]
    return [source.read_bytes() if isinstance(source, Path) else source for source in sources]


def _check_readable(tree: dict[str, Any], path: Path) -> None:
    """Raise SceneError if geometry of a glTF file is stored in a way that is not read."""
    primitives = _primitives(tree)
    positions = [tree["accessors"][primitive["attributes"]["POSITION"]] for primitive in primitives]
    # materials and textures may change how a mesh appears, but not where it is
    unread = {
        name for name in tree.get("extensionsRequired", []) if not re.match("KHR_(mat|tex|lig|mesh_q)|EXT_tex", name)
    }
    unread |= {"EXT_mesh_gpu_instancing"} & {*tree.get("extensionsUsed", [])}
    unread |= {"skins" for node in tree.get("nodes", []) if "skin" in node}
    unread |= {"morph targets" for mesh in tree.get("meshes", []) if any(mesh.get("weights", ()))}
    if any("bufferView" not in position or "sparse" in position for position in positions):
        unread |= {name for primitive in primitives for name in primitive.get("extensions", {})} or {"sparse accessors"}
    if any(primitive.get("mode") == 6 for primitive in primitives):
        unread.add("triangle fans")
    if unread:
        fix = "Export it from Blender as GLB without compression and instances, or as PLY."
        problem = "the mesh is compressed, or stored in another way that is not read"
        raise SceneError(problem, path=path, value=", ".join(sorted(unread)), fix=fix)


def _with_all_applied(path: Path) -> tuple[io.BytesIO, str] | None:
    """The file as glTF with what trimesh ignores applied: normalized integers, and transforms of textures; None without.

    Normalized integers (glTF 2.0, 3.6.2.2) become float numbers, other than colours, which trimesh expects as integers.
    Texture coordinates are transformed by the extension KHR_texture_transform of their material's colour.
    """
    tree, content = _read_glb(path)
    accessors = tree.get("accessors", [])
    primitives = _primitives(tree)
    used = {at for primitive in primitives for name, at in primitive["attributes"].items() if name[:5] != "COLOR"}
    changed: list[tuple[dict[str, Any], dict[str, Any]]] = [
        (accessors[at], {}) for at in sorted(used) if accessors[at].get("normalized")
    ]
    for primitive in primitives:
        material = tree["materials"][primitive["material"]] if "material" in primitive else {}
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        if transform := texture.get("extensions", {}).get("KHR_texture_transform"):
            chosen = {**texture, **transform}.get("texCoord", 0)
            accessor = {**accessors[primitive["attributes"][f"TEXCOORD_{chosen}"]]}
            primitive["attributes"]["TEXCOORD_0"] = len(accessors)
            accessors.append(accessor)
            changed.append((accessor, transform))
    if not changed:
        return None
    buffers = _buffers(tree, content, path)
    decoded = b""
    for accessor, transform in changed:
        view = tree["bufferViews"][accessor["bufferView"]]
        kind = np.dtype({5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}[accessor["componentType"]])
        shape = accessor["count"], {"VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        strides = view.get("byteStride", shape[1] * kind.itemsize), kind.itemsize
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        numbers = np.ndarray(shape, kind, buffers[view["buffer"]], start, strides)
        if accessor.get("normalized"):
            numbers = np.maximum(numbers / np.float32(np.iinfo(kind).max), -1)
        if transform:
            angle = transform.get("rotation", 0)
            turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
            numbers = numbers * transform.get("scale", (1, 1)) @ turn.T + transform.get("offset", (0, 0))
        values = numbers.astype("<f4").tobytes()
        accessor |= {
            "bufferView": len(tree["bufferViews"]),
            "byteOffset": 0,
            "componentType": 5126,
            "normalized": False,
        }
        tree["bufferViews"].append({"buffer": len(buffers), "byteOffset": len(decoded), "byteLength": len(values)})
        decoded += values
    tree["buffers"] = []
    for buffer in (*buffers, decoded):
        uri = f"data:application/octet-stream;base64,{base64.b64encode(buffer).decode()}"
        tree["buffers"].append({"byteLength": len(buffer), "uri": uri})
    return io.BytesIO(json.dumps(tree).encode()), "gltf"


def _with_positive_indices(path: Path) -> tuple[io.StringIO, str] | None:
    """The text of an OBJ file with indices from the start of the file for those from the line, which trimesh ignores.

    None if it has no such index. Raises ValueError for one before the first element.
    """
    with path.open(encoding="utf-8", errors="replace") as file:
        if not any(line.startswith("f") and "-" in line for line in file):
            return None
    counts = dict.fromkeys(("v", "vt", "vn"), 0)
    lines = []
    for line in path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ").splitlines():
        words = line.split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        elif words and words[0] == "f" and "-" in line:
            corners = [word.split("/") for word in words[1:]]
            line = " ".join(["f", *("/".join(map(_positive, corner, counts.values())) for corner in corners)])
        lines.append(line)
    return io.StringIO("\n".join(lines) + "\n"), "obj"


def _positive(index: str, count: int) -> str:
    """An OBJ index from 1, of one that may count back from the last of `count` elements; "" stays."""
    if not index.startswith("-"):
        return index
    if count + int(index) < 0:
        raise ValueError(f"index {index} after {count} elements")
    return str(count + 1 + int(index))


def _at_uri(uri: str, path: Path) -> Path | bytes:
    """The file, or the content of a `data:` URI, that the mesh at `path` names."""
    kind, _, content = uri.partition(",")
    if not kind.startswith("data:"):
        return _sibling(path, uri)
    if not kind.endswith(";base64"):
        raise ValueError(f"a URI without base64, {kind[:40]!r}")
    return base64.b64decode(content, validate=True)


def _ply_textures(path: Path) -> Iterator[Path | bytes]:
    """Textures that a PLY file names in comments. Raises ValueError if it is a text with fewer rows than it states."""
    with path.open("rb") as file:
        start, _, rest = file.read(1 << 16).partition(b"end_header")
        header = start.decode("utf-8", errors="replace")
        stated = sum(map(int, re.findall(r"^element \S+ (\d+)", header, re.M)))
        if "format ascii" in header and rest.count(b"\n") + sum(1 for _ in file) < stated:
            raise ValueError(f"fewer rows than the {stated:,} of its header")
    for line in header.splitlines():
        if line.lower().startswith("comment texturefile "):
            yield _sibling(path, line.strip()[len("comment texturefile ") :].strip())


def _obj_textures(path: Path) -> Iterator[Path | bytes]:
    """Textures that an OBJ file's materials name. Raises ValueError if the file has too many parts."""
    parts = dict.fromkeys(("usemtl", "o", "g"), 0)
    libraries = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("mtllib "):
                libraries.append(line[7:].strip())
            elif line.startswith(("usemtl ", "o ", "g ")):
                parts[line.split(maxsplit=1)[0]] += 1
    if max(parts.values()) > 5000:  # trimesh takes the square of their number
        raise ValueError(f"{max(parts.values()):,} parts; join them to 5,000, or export a GLB file")
    for name in libraries:
        library = _sibling(path, name)
        for line in read_text(library).splitlines():
            # A map with options (-s, -o ...) before its file name is not checked.
            words = line.split(maxsplit=1)
            if len(words) == 2 and words[0].lower() == "map_kd" and not words[1].startswith("-"):
                yield _sibling(library, words[1].strip().replace("\\", "/"))


def _parts(scene: trimesh.Scene) -> Iterator[_Part]:
    """The triangle meshes of a scene with their node transforms applied, in the order of the file."""
    order = {name: number for number, name in enumerate(scene.geometry)}
    for node in sorted(scene.graph.nodes_geometry, key=lambda node: (order[scene.graph[node][1]], node)):
        matrix, name = scene.graph[node]
        part: Any = scene.geometry[name]
        if isinstance(scene.geometry[name], trimesh.Trimesh) and len(part.faces):
            if part.visual.kind == "face":  # colours by face become colours by vertex
                part = part.copy()
                part.unmerge_vertices()
            yield _part(part, np.asarray(matrix, dtype=np.float64))


def _part(geometry: Any, matrix: NDArray[np.float64]) -> _Part:
    with np.errstate(invalid="ignore"):  # `_cleaned` reports vertices that are not finite
        vertices = np.asarray(geometry.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    triangles = np.asarray(geometry.faces, dtype=np.int64)
    if np.linalg.det(matrix[:3, :3]) < 0:  # a mirroring transform turns triangles inside out
        triangles = triangles[:, ::-1]

    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(f"a triangle has vertex {triangles.max()} of {len(vertices)}")

    visual = geometry.visual
    uvs = None
    colors = None
    texture = _WHITE
    if visual.kind == "texture":
        colors = visual.vertex_attributes.get("color")
        image, factor = _material(visual.material)
        if image is not None and visual.uv is not None:
            uvs = np.asarray(visual.uv, dtype=np.float64) * (1, -1) + (0, 1)
            if uvs.shape != (len(vertices), 2):
                raise ValueError(f"texture coordinates of shape {uvs.shape} for {len(vertices)} vertices")
            texture = np.array(image.convert("RGB"), dtype=np.uint8)
        if factor is not None:
            texture = np.rint(texture * factor).astype(np.uint8)
    elif visual.kind in ("vertex", "face"):
        colors = visual.vertex_colors
    if colors is not None:
        colors = _as_uint8(np.asarray(colors)[:, :3])
        if colors.shape != (len(vertices), 3):
            raise ValueError(f"colours of shape {colors.shape} for {len(vertices)} vertices")
    return _Part(vertices, triangles, uvs, texture, colors)


def _material(material: Any) -> tuple[Image.Image | None, NDArray[np.float64] | None]:
    """A material's image, and the colour (3,) in sRGB 0..1 that multiplies it; each None if there is none."""
    if isinstance(material, trimesh.visual.material.PBRMaterial):
        image = material.baseColorTexture
        factor = material.baseColorFactor
        if factor is None:
            return image, None
        linear = np.asarray(factor, dtype=np.float64)[:3] / 255  # glTF factors are linear, and trimesh keeps 8 bits
        color = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return image, None if image is not None and (linear == 1).all() else color
    image = getattr(material, "image", None)
    diffuse = getattr(material, "diffuse", None)
    # For a PLY file with texture coordinates and no texture, trimesh inserts a placeholder of 2 x 2 pixels.
    placeholder = isinstance(image, Image.Image) and image.size == (2, 2) and image.mode == "RGBA"
    if placeholder and not hasattr(image, "filename"):
        image = None
    # With an image, viewers of OBJ files disagree on Kd, so it is ignored; so is the grey that is trimesh's default.
    default = trimesh.visual.material.SimpleMaterial().diffuse
    if image is not None or diffuse is None or np.array_equal(diffuse, default):
        return image, None
    return None, np.asarray(diffuse, dtype=np.float64)[:3] / 255


def _as_uint8(colors: NDArray[Any]) -> NDArray[np.uint8]:
    if colors.dtype == np.uint8:
        return colors
    scale = 255.0 / np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else 255.0
    return np.clip(np.rint(colors * scale), 0, 255).astype(np.uint8)


def _merge(parts: list[_Part], rotation: NDArray[np.float64]) -> TexturedMesh:
    """One mesh of all parts; parts that share an image share a texture."""
    textures: dict[tuple[tuple[int, ...], bytes], int] = {}
    images: list[NDArray[np.uint8]] = []
    triangle_texture = []
    corner_uvs = []
    triangles = []
    n_vertices = 0
    for part in parts:
        key = (part.texture.shape, hashlib.sha256(np.ascontiguousarray(part.texture).data).digest())
        if key not in textures:
            textures[key] = len(images)
            images.append(part.texture)
        uvs = np.full((len(part.vertices), 2), 0.5) if part.uvs is None else part.uvs
        corner_uvs.append(uvs[part.triangles])
        triangle_texture.append(np.full(len(part.triangles), textures[key], dtype=np.int32))
        triangles.append(part.triangles + n_vertices)
        n_vertices += len(part.vertices)
    colors = None
    if any(part.colors is not None for part in parts):
        white = [np.full((len(p.vertices), 3), 255, np.uint8) if p.colors is None else p.colors for p in parts]
        colors = np.concatenate(white)
    with np.errstate(invalid="ignore"):
        world = np.concatenate([part.vertices for part in parts]) @ rotation.T
        origin = local_origin(world)
        vertices = (world - origin).astype(np.float32)
    indices = np.concatenate(triangles).astype(np.int32)
    all_uvs = np.concatenate(corner_uvs).astype(np.float32)
    return TexturedMesh(vertices, indices, all_uvs, np.concatenate(triangle_texture), tuple(images), colors, origin)


def _cleaned(mesh: TexturedMesh, path: Path) -> TexturedMesh:
    """Remove triangles without area and unused vertices. Raises SceneError for NaN, or if the rest is empty or flat."""
    finite = [bool(np.isfinite(values).all()) for values in (mesh.vertices, mesh.corner_uvs)]
    if not all(finite):
        what = "texture coordinates" if finite[0] else "vertices"
        raise SceneError(f"some {what} are NaN or infinite", path=path, fix="Clean the mesh, for instance in MeshLab")
    keep = 0.5 * np.linalg.norm(mesh.normals, axis=1) > 1e-12  # m^2: a square of a thousandth of a millimetre
    if not keep.any():
        raise SceneError("all triangles are degenerate", path=path, value=len(keep), fix="Check the export")
    cleaned = mesh.only(keep)
    extent = np.ptp(cleaned.bounds, axis=0)
    if (extent < 1e-3).any():
        fix = "A scene needs an extent in x, y and z, in metres"
        raise SceneError("the mesh is flat", path=path, value=extent.tolist(), fix=fix)
    return cleaned


def _geometry(mesh: TexturedMesh, faces: NDArray[np.int64], image: _EncodedJpeg) -> trimesh.Trimesh:
    """The triangles of one texture, with a vertex for each pair of a position and texture coordinates."""
    index = mesh.triangles[faces].reshape(-1)
    uv = mesh.corner_uvs[faces].reshape(-1, 2)
    keys = np.column_stack([index.astype(np.int32), uv.view(np.int32)])
    _, first, corners = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    matte = {"metallicFactor": 0.0, "roughnessFactor": 1.0, "doubleSided": True}
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, **matte)
    visual = trimesh.visual.TextureVisuals(uv=uv[first].astype(np.float64) * (1, -1) + (0, 1), material=material)
    if mesh.vertex_colors is not None:
        opaque = np.full((len(first), 1), 255, dtype=np.uint8)
        visual.vertex_attributes["color"] = np.hstack([mesh.vertex_colors[index[first]], opaque])
    return trimesh.Trimesh(mesh.vertices[index[first]], corners.reshape(-1, 3), visual=visual, process=False)


class _EncodedJpeg:
    """A JPEG with the interface of a PIL image that trimesh writes as it is; it would encode an image at quality 75."""

    format = "JPEG"

    def __init__(self, texture: NDArray[np.uint8], quality: int) -> None:
        buffer = io.BytesIO()
        # Chroma stays at full resolution, as subsampling would blur colours across the charts of an atlas.
        Image.fromarray(texture).save(buffer, format="JPEG", quality=quality, subsampling=0)
        self.encoded = buffer.getvalue()

    def save(self, file: io.BytesIO, **_: Any) -> None:
        file.write(self.encoded)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[np.uint8]:
        return np.frombuffer(self.encoded, dtype=np.uint8)  # trimesh compares materials by this array


def _mark_unlit(tree: dict[str, Any]) -> None:
    """Declare that light is baked into the textures (glTF extension KHR_materials_unlit)."""
    for material in tree.get("materials", []):
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree.setdefault("extensionsUsed", []).append("KHR_materials_unlit")
