"""Reading and writing meshes, against files written by hand or by trimesh."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from box_scenes import furnished_room, quads_mesh, random_texture
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.utils.errors import ConfigError, SceneError

VERTICES = np.array([[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 1]], dtype=np.float64)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UVS_UP = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)  # as trimesh and OBJ have them: v up
UVS_DOWN = UVS_UP * (1, -1) + (0, 1)


@pytest.fixture
def texture():
    return random_texture(np.random.default_rng(0), 4, 6)


def textured(texture, vertices=VERTICES, **material):
    material = PBRMaterial(baseColorTexture=Image.fromarray(texture), **material)
    return trimesh.Trimesh(vertices, FACES, visual=TextureVisuals(UVS_UP, material), process=False)


def assert_is_the_quad(mesh, texture, uvs=UVS_DOWN):
    assert_array_equal(mesh.vertices[mesh.triangles], VERTICES[FACES].astype(np.float32))
    assert_allclose(mesh.corner_uvs, uvs[FACES], atol=1e-7)
    assert_array_equal(mesh.textures[mesh.triangle_texture[0]], texture)
    assert mesh.vertices.dtype == np.float32 and mesh.corner_uvs.dtype == np.float32
    assert mesh.triangles.dtype == np.int32 and mesh.triangle_texture.dtype == np.int32


def test_glb_with_a_node_transform_and_several_materials(tmp_path, texture):
    other = random_texture(np.random.default_rng(1), 3, 3)
    scene = trimesh.Scene()
    scene.add_geometry(textured(texture), transform=trimesh.transformations.translation_matrix((10, 20, 30)))
    quarter = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1))
    scene.add_geometry(textured(other), transform=quarter)
    scene.add_geometry(textured(texture), transform=trimesh.transformations.translation_matrix((0, 0, -5)))
    scene.export(tmp_path / "a.glb")
    mesh = load_mesh(tmp_path / "a.glb")
    assert len(mesh.textures) == 2, "the same image twice is one texture"
    turned = VERTICES * (1, 1, 1)
    turned[:, 0] = -VERTICES[:, 1]
    turned[:, 1] = VERTICES[:, 0]
    expected = [(VERTICES + np.array((10, 20, 30)), texture), (turned, other), (VERTICES - (0, 0, 5), texture)]
    found = mesh.vertices[mesh.triangles].reshape(-1, 2, 3, 3)
    for vertices, image in expected:
        (part,) = [i for i, corners in enumerate(found) if np.allclose(corners, vertices[FACES], atol=1e-5)]
        assert_array_equal(mesh.textures[mesh.triangle_texture[2 * part]], image)


def test_a_mirroring_transform_keeps_fronts_in_front(tmp_path, texture):
    scene = trimesh.Scene()
    scene.add_geometry(textured(texture), transform=np.diag([-1.0, 1, 1, 1]))
    scene.export(tmp_path / "a.glb")
    mesh = load_mesh(tmp_path / "a.glb")
    assert_allclose(mesh.vertices[mesh.triangles], (VERTICES * (-1, 1, 1))[FACES[:, ::-1]], atol=1e-6)
    assert_allclose(mesh.corner_uvs, UVS_DOWN[FACES[:, ::-1]], atol=1e-7)


def test_glb_factors_and_vertex_colors(tmp_path, texture):
    # A linear factor of 55 / 255 is 0.2157, which is 0.5019 in sRGB.
    textured(texture, baseColorFactor=[55, 255, 0, 255]).export(tmp_path / "tinted.glb")
    tinted = load_mesh(tmp_path / "tinted.glb").textures[0]
    assert np.abs(tinted - texture * (0.5019, 1.0, 0.0)).max() <= 0.51

    plain = trimesh.Trimesh(VERTICES, FACES, process=False)
    plain.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[55, 0, 255, 255]))
    plain.export(tmp_path / "plain.glb")
    mesh = load_mesh(tmp_path / "plain.glb")
    assert_array_equal(mesh.textures[0], [[[128, 0, 255]]])

    colored = textured(texture)
    colors = np.random.default_rng(2).integers(0, 256, (4, 4), dtype=np.uint8)
    colored.visual.vertex_attributes["color"] = colors
    colored.export(tmp_path / "colored.glb")
    mesh = load_mesh(tmp_path / "colored.glb")
    assert_is_the_quad(mesh, texture)
    assert_array_equal(mesh.vertex_colors, colors[:, :3])


OBJ = """mtllib a.mtl
v 0 0 0
v 2 0 0
v 2 3 0
v 0 3 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl picture
f 1/1 2/2 3/3
usemtl blue
f 1/1 3/3 4/4
"""
MTL = "newmtl picture\nKd 1 1 1\nmap_Kd my texture.png\nnewmtl blue\nKd 0.2 0.4 0.6\n"


def test_obj_with_two_materials(tmp_path, texture):
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text(MTL)
    Image.fromarray(texture).save(tmp_path / "my texture.png")
    mesh = load_mesh(tmp_path / "a.obj")
    assert len(mesh.textures) == 2
    by_height = np.argsort(mesh.vertices[mesh.triangles][:, :, 2].max(axis=1))
    assert_array_equal(mesh.vertices[mesh.triangles[by_height]], VERTICES[FACES])
    assert_allclose(mesh.corner_uvs[by_height[0]], UVS_DOWN[FACES[0]], atol=1e-7)
    assert_array_equal(mesh.textures[mesh.triangle_texture[by_height[0]]], texture)
    assert_array_equal(mesh.textures[mesh.triangle_texture[by_height[1]]], [[[51, 102, 153]]])

    (tmp_path / "my texture.png").unlink()
    with pytest.raises(SceneError):
        load_mesh(tmp_path / "a.obj")
    (tmp_path / "a.mtl").unlink()
    with pytest.raises(SceneError):
        load_mesh(tmp_path / "a.obj")


def ply(vertex_properties="", vertex_values=("",) * 4, face_properties="", face_values=("",) * 2, comment=""):
    lines = ["ply", "format ascii 1.0", *([comment] if comment else []), "element vertex 4"]
    lines += [f"property float {axis}" for axis in "xyz"] + ([vertex_properties] if vertex_properties else [])
    lines += ["element face 2", "property list uchar int vertex_indices"]
    lines += ([face_properties] if face_properties else []) + ["end_header"]
    lines += [f"{x:g} {y:g} {z:g} {more}" for (x, y, z), more in zip(VERTICES, vertex_values, strict=True)]
    lines += [f"3 {a} {b} {c} {more}" for (a, b, c), more in zip(FACES, face_values, strict=True)]
    return "\n".join(lines) + "\n"


def test_ply_with_texture_coordinates_by_corner(tmp_path, texture):
    # The corner of vertex 0 has other texture coordinates in each triangle.
    uvs = np.stack([UVS_UP[FACES[0]], [[0.5, 0], [1, 1], [0, 1]]])
    values = ["6 " + " ".join(f"{value:g}" for value in corners.reshape(-1)) for corners in uvs]
    content = ply(
        face_properties="property list uchar float texcoord", face_values=values, comment="comment TextureFile t.png"
    )
    (tmp_path / "a.ply").write_text(content)
    Image.fromarray(texture).save(tmp_path / "t.png")
    mesh = load_mesh(tmp_path / "a.ply")
    assert_array_equal(mesh.vertices[mesh.triangles], VERTICES[FACES])
    assert_allclose(mesh.corner_uvs, uvs * (1, -1) + (0, 1), atol=1e-7)
    assert_array_equal(mesh.textures[0], texture)
    (tmp_path / "t.png").unlink()
    with pytest.raises(SceneError):
        load_mesh(tmp_path / "a.ply")


def test_ply_with_colors(tmp_path):
    rgb = "\n".join(f"property uchar {name}" for name in ("red", "green", "blue"))
    colors = np.random.default_rng(0).integers(0, 256, (4, 3))
    (tmp_path / "v.ply").write_text(ply(rgb, [" ".join(map(str, color)) for color in colors]))
    mesh = load_mesh(tmp_path / "v.ply")
    assert_array_equal(mesh.vertices, VERTICES)
    assert_array_equal(mesh.vertex_colors, colors)
    assert_array_equal(mesh.textures[0], [[[255, 255, 255]]])

    for values in ((), ("property float s\nproperty float t", ["0 0"] * 4)):  # neither colours nor an image
        (tmp_path / "plain.ply").write_text(ply(*values))
        with pytest.raises(SceneError):
            load_mesh(tmp_path / "plain.ply")
    faces = trimesh.Trimesh(VERTICES, FACES, process=False)
    faces.visual = ColorVisuals(faces, face_colors=np.array([[1, 2, 3, 255], [7, 8, 9, 255]], np.uint8))
    faces.export(tmp_path / "f.ply")
    mesh = load_mesh(tmp_path / "f.ply")
    assert_array_equal(mesh.vertices[mesh.triangles], VERTICES[FACES])
    assert_array_equal(mesh.vertex_colors[mesh.triangles], [[[1, 2, 3]] * 3, [[7, 8, 9]] * 3])


@pytest.mark.parametrize(
    ("up", "axis"),
    [("x", (1, 0, 0)), ("-x", (-1, 0, 0)), ("y", (0, 1, 0)), ("-y", (0, -1, 0)), ("z", (0, 0, 1)), ("-z", (0, 0, -1))],
)
def test_up_axis_becomes_z_without_mirroring(tmp_path, texture, up, axis):
    textured(texture).export(tmp_path / "a.glb")
    mesh = load_mesh(tmp_path / "a.glb", up=up)
    assert_allclose(mesh.vertices[:, 2], VERTICES @ axis, atol=1e-6)
    a, b, c = mesh.vertices[1:] - mesh.vertices[0]
    assert np.dot(np.cross(a, b), c) == pytest.approx(np.linalg.det(VERTICES[1:] - VERTICES[0]))


def test_degenerate_triangles_and_loose_vertices_are_dropped(tmp_path, texture):
    mesh = textured(texture, vertices=VERTICES)
    vertices = np.concatenate([VERTICES, [[0, 0, 0], [1, 0, 0], [2, 0, 0], [99, 99, 99]]])
    faces = np.concatenate([FACES, [[4, 5, 6], [1, 1, 2]]])
    uvs = np.concatenate([UVS_UP, np.zeros((4, 2))])
    visual = TextureVisuals(uvs, mesh.visual.material)
    trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(tmp_path / "a.glb")
    loaded = load_mesh(tmp_path / "a.glb")
    assert_is_the_quad(loaded, texture)
    assert_array_equal(loaded.bounds, [[0, 0, 0], [2, 3, 1]])


def test_invalid_arguments_are_rejected(tmp_path):
    textured(random_texture(np.random.default_rng(0), 4, 6)).export(tmp_path / "a.glb")
    with pytest.raises(ConfigError):
        load_mesh(tmp_path / "a.glb", up="up")
    with pytest.raises(ConfigError):
        save_glb(load_mesh(tmp_path / "a.glb"), tmp_path / "b.glb", jpeg_quality=0)


@pytest.mark.parametrize("colored", [False, True])
def test_saved_glb_loads_again(tmp_path, colored):
    mesh = furnished_room()
    if colored:
        colors = np.random.default_rng(0).integers(0, 256, mesh.vertices.shape, dtype=np.uint8)
        textures = [np.full((8, 8, 3), 20 + 40 * k, dtype=np.uint8) for k in range(5)]
        mesh = quads_mesh(mesh.vertices.reshape(-1, 4, 3), textures, vertex_colors=colors)
    save_glb(mesh, tmp_path / "a.glb", jpeg_quality=95)
    again = load_mesh(tmp_path / "a.glb")
    order = np.argsort(mesh.triangle_texture, kind="stable")  # written texture by texture
    assert_array_equal(again.vertices[again.triangles], mesh.vertices[mesh.triangles[order]])
    assert_allclose(again.corner_uvs, mesh.corner_uvs[order], atol=1e-6)
    assert_array_equal(again.triangle_texture, mesh.triangle_texture[order])
    if colored:
        assert_array_equal(again.vertex_colors[again.triangles], mesh.vertex_colors[mesh.triangles[order]])
    for texture, saved in zip(mesh.textures, again.textures, strict=True):
        assert texture.shape == saved.shape
        assert np.abs(texture.astype(int) - saved).max() <= (2 if colored else 40)  # JPEG of white noise
    assert [file.name for file in tmp_path.iterdir()] == ["a.glb"], "no temporary file is left"
    assert len(again.vertices) <= len(mesh.vertices)
