"""Tests of scenes from files, compared with trimesh, with formulas, and between formats."""

import json
import os
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from PIL import Image

from framework.errors import DataError
from framework.renderer import Scene
from framework.scenes import parts
from framework.scenes.scene_files import UPWARDS, read
from framework.testing.sample_scenes import (
    CORNERS,
    MTL,
    OBJ,
    ORDER,
    UV,
    describe,
    glb,
    pack_glb,
    png,
    quad,
)

FOUR = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
"""An image with red and green above, blue and white below."""
REAL = os.environ.get("REAL_DATA_ROOT")


def to_linear(stored: NDArray) -> NDArray:
    """Return linear RGB of 8-bit sRGB, by the formula of IEC 61966-2-1."""
    share = stored / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def textured_square(
    image: bytes | None = None, **changes: Any
) -> tuple[dict[str, Any], list[NDArray | bytes]]:
    """Return description and binary parts of a square from (0, 0) to (1, 1) with an upright texture.

    `changes` are added to its material.
    """
    content: dict[str, Any] = {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, **changes}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3}],
    }
    return content, [CORNERS, UV, ORDER, image or png(FOUR)]


def write_scene(
    folder: Path,
    content: dict[str, Any],
    arrays: list[NDArray | bytes],
    name: str = "one.glb",
    change: Callable[[dict[str, Any]], object] = lambda _: None,
) -> Path:
    """Write a .glb, or a .gltf with one file beside it; `change` modifies the complete description."""
    whole, binary = describe(content, arrays)
    file = folder / name
    if name.endswith(".gltf"):
        whole["buffers"][0]["uri"] = "one%20part.bin"
        (folder / "one part.bin").write_bytes(binary)
    change(whole)
    text = json.dumps(whole).encode()
    file.write_bytes(pack_glb(text, binary) if name.endswith(".glb") else text)
    return file


def texel_at_corner(scene: Scene, face: int, corner: int, inwards: float = 0.1) -> NDArray:
    """Return the texel at a point a little inside of a face's corner, with u to the right and v upwards."""
    texture = scene.texture
    assert texture is not None
    places = texture.uv[texture.faces[face]].numpy()
    u, v = places[corner] + inwards * (places.mean(0) - places[corner])
    image = texture.images[0 if texture.shown is None else int(texture.shown[face])].numpy()
    height, width = image.shape[:2]
    return image[int((1 - v) * height), int(u * width)]


@pytest.mark.parametrize("name", ["one.glb", "one.gltf"])
def test_a_texture_stands_upright(tmp_path: Path, name: str) -> None:
    scene = read(write_scene(tmp_path, *textured_square(), name=name)).scene
    wanted = {(0, 0): FOUR[1, 0], (1, 0): FOUR[1, 1], (1, 1): FOUR[0, 1], (0, 1): FOUR[0, 0]}
    for face, corner in product(range(2), range(3)):
        x, y, _ = scene.vertices[scene.faces[face, corner]].int().tolist()
        np.testing.assert_allclose(texel_at_corner(scene, face, corner), to_linear(wanted[x, y]), atol=1e-6)
    assert scene.texture is not None
    reference = trimesh.load(
        write_scene(tmp_path, *textured_square(), name="two.glb"), force="mesh", process=False
    )
    np.testing.assert_allclose(scene.texture.uv, reference.visual.uv, atol=1e-6)


@pytest.mark.parametrize(("width", "kind"), [*product([3, 4], ["<f4", "u1", "<u2"])])
def test_colours_are_multiplied_in_linear_light(tmp_path: Path, width: int, kind: str) -> None:
    shares = np.array([[0.1, 0.5, 1, 1], [1, 0, 0.25, 0], [0.6, 0.7, 0.8, 1], [0, 0, 0, 1]])[:, :width]
    full = 1 if kind == "<f4" else np.iinfo(kind).max
    stored = (shares * full).astype(kind)
    content, arrays = textured_square(baseColorFactor=[0.5, 0.25, 1, 1])
    content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 3
    content["images"] = [{"bufferView": 4}]
    subject = read(write_scene(tmp_path, content, [*arrays[:3], stored, arrays[3]]))
    assert subject.scene.colors is not None and subject.scene.texture is not None and not subject.plain.any()
    np.testing.assert_allclose(subject.scene.colors, stored[:, :3] / full * [0.5, 0.25, 1], atol=1e-6)
    np.testing.assert_allclose(subject.scene.texture.images[0], to_linear(FOUR), atol=1e-6)


def test_parts_without_colour_are_grey_and_parts_of_one_colour_are_shaded(tmp_path: Path) -> None:
    content, arrays = textured_square()
    del content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    for factor, wanted in ((None, [parts.GREY] * 3), ([0.1, 0.2, 0.3, 0.5], [0.1, 0.2, 0.3])):
        if factor:
            content["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = factor
        subject = read(write_scene(tmp_path, content, arrays))
        assert subject.plain.all() and subject.scene.texture is None and subject.scene.colors is not None
        np.testing.assert_allclose(subject.scene.colors, np.tile(wanted, (4, 1)), atol=1e-6)


def test_nodes_are_placed_as_by_trimesh(tmp_path: Path) -> None:
    """Compare trees of rotated, scaled and mirrored nodes: corners and orientation of faces."""
    random = np.random.default_rng(0)
    for _ in range(5):
        nodes: list[dict[str, Any]] = []
        for number in range(6):
            turn = random.normal(size=4)
            moves = {
                "rotation": (turn / np.linalg.norm(turn)).tolist(),
                "translation": random.normal(size=3).tolist(),
            }
            moves["scale"] = (random.uniform(0.5, 2, 3) * random.choice([-1, 1], 3)).tolist()
            matrix = trimesh.transformations.random_rotation_matrix(random.random(3)) * [1, 2, -1, 1]
            nodes.append({"mesh": 0, **(moves if number % 2 else {"matrix": matrix.T.ravel().tolist()})})
            if number:
                nodes[int(random.integers(number))].setdefault("children", []).append(number)
        content, arrays = textured_square()
        file = write_scene(tmp_path, {**content, "nodes": nodes}, arrays)
        scene, reference = read(file).scene, trimesh.load(file, force="mesh", process=False)
        ours = scene.vertices[scene.faces].numpy()
        theirs = reference.vertices[reference.faces]
        areas = [
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            for corners in (ours, theirs)
        ]
        actual, expected = (
            np.concatenate([corners.mean(1), area], 1)
            for corners, area in zip((ours, theirs), areas, strict=True)
        )
        np.testing.assert_allclose(np.sort(actual, 0), np.sort(expected, 0), atol=1e-5)
        distance = np.linalg.norm(actual[:, None] - expected, axis=2)
        assert (distance.min(0) < 1e-5).all() and (distance.min(1) < 1e-5).all()


@pytest.mark.parametrize(("mode", "order"), [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans_are_converted_to_triangles(tmp_path: Path, mode: int, order: list[int]) -> None:
    """Check that all faces face z; vertices and texture coordinates are interleaved, and one vertex is sparse."""
    content, arrays = textured_square()
    content["meshes"][0]["primitives"][0]["mode"] = mode
    content["images"] = [{"bufferView": 2}]
    rows, values = {"bufferView": 3, "componentType": 5121}, {"bufferView": 4}
    numbers = {"bufferView": 0, "componentType": 5126, "count": 4}
    content["accessors"] = [
        {**numbers, "type": "VEC3", "sparse": {"count": 1, "indices": rows, "values": values}},
        {**numbers, "type": "VEC2", "byteOffset": 12},
    ]
    mixed = np.concatenate([CORNERS, UV], 1).tobytes()
    moved = np.array([5, 5, 0], "<f4").tobytes()
    binary_parts = [mixed, np.array(order, "<u2"), arrays[3], b"\2", moved]
    scene = read(
        write_scene(
            tmp_path,
            content,
            binary_parts,
            change=lambda whole: whole["bufferViews"][0].update(byteStride=20),
        )
    ).scene
    corners = scene.vertices[scene.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert (area > 0).all()
    assert float(area.sum()) == 5.0  # a kite: (0, 0), (1, 0), (5, 5), (0, 1)
    assert scene.texture is not None
    np.testing.assert_allclose(scene.texture.uv, np.stack([UV[:, 0], 1 - UV[:, 1]], 1))


def test_a_skin_follows_its_joints(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    inverse, weights = random.normal(size=(2, 4, 4)), random.uniform(0.1, 1, (4, 4))
    inverse[:, 3] = [0, 0, 0, 1]
    weights[:, 2:] = 0
    weights /= weights.sum(1, keepdims=True)
    joints = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [1, 1, 0, 0]], "u1")
    content, arrays = textured_square()
    content["meshes"][0]["primitives"][0]["attributes"] |= {"JOINTS_0": 3, "WEIGHTS_0": 4}
    content["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [9, 9, 9]},
        {"translation": [1, 2, 3], "children": [2]},
        {"scale": [1, 2, 1], "rotation": [0, 0, 0.6, 0.8]},
    ]
    content["scenes"] = [{"nodes": [0, 1]}]
    content["skins"] = [{"joints": [2, 1], "inverseBindMatrices": 5}]
    content["images"] = [{"bufferView": 6}]
    stored = inverse.transpose(0, 2, 1).reshape(2, 16).astype("<f4")
    subject = read(
        write_scene(tmp_path, content, [*arrays[:3], joints, weights.astype("<f4"), stored, arrays[3]])
    )
    assert subject.notes == ("the model is drawn in its rest pose.",)
    first, second = np.eye(4), np.eye(4)
    first[:3, 3] = [1, 2, 3]
    cos, sin = 0.8**2 - 0.6**2, 2 * 0.6 * 0.8  # the file contains half the angle
    second[:3, :3] = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.diag([1, 2, 1])
    places = [first @ second, first]
    for vertex in range(4):
        point = np.append(CORNERS[vertex], 1)
        wanted = sum(
            weights[vertex, k] * (places[joints[vertex, k]] @ inverse[joints[vertex, k]] @ point)
            for k in range(4)
        )
        np.testing.assert_allclose(subject.scene.vertices[vertex], wanted[:3], atol=1e-5)


def test_a_texture_may_be_moved_turned_and_scaled(tmp_path: Path) -> None:
    """Check that the rotation is counter-clockwise on the image, with v downwards: from right to up, which is -v."""
    content, arrays = textured_square()
    moved = {"offset": [0.25, 0.5], "rotation": np.pi / 2, "scale": [2, 3]}
    content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = {
        "KHR_texture_transform": moved
    }
    texture = read(write_scene(tmp_path, content, arrays)).scene.texture
    assert texture is not None
    u, v = UV.T
    downwards = np.stack([0.25 + 3 * v, 0.5 - 2 * u], 1)  # (2u, 0) becomes (0, -2u), (0, 3v) becomes (3v, 0)
    np.testing.assert_allclose(texture.uv, np.stack([downwards[:, 0], 1 - downwards[:, 1]], 1), atol=1e-6)


NUMBERS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}


@pytest.mark.parametrize(
    ("samplers", "reach", "wanted"),
    [
        (["repeat"], 3, "repeat"),
        (["clamp"], 3, "clamp"),
        (["mirror"], 1, "mirror"),
        (["mirror", "clamp"], 1, "clamp"),
        ([None, "clamp"], 1, "clamp"),
        ([None], 1, "repeat"),
        (["mirror", "clamp"], 3, None),
    ],
)
def test_the_wrap_rule_of_a_texture_is_read(
    tmp_path: Path, samplers: list[str | None], reach: int, wanted: str | None
) -> None:
    """Check that a scene has one wrap rule, and that textures need none if all uv lie inside."""
    content, arrays = textured_square()
    content["textures"], content["samplers"], content["materials"], content["meshes"] = [], [], [], []
    content["nodes"] = [{"mesh": number, "translation": [number, 0, 0]} for number in range(len(samplers))]
    content["scenes"] = [{"nodes": [*range(len(samplers))]}]
    for number, name in enumerate(samplers):
        attributes = {"POSITION": 0, "TEXCOORD_0": 1}
        content["meshes"].append(
            {"primitives": [{"attributes": attributes, "indices": 2, "material": number}]}
        )
        content["materials"].append({"pbrMetallicRoughness": {"baseColorTexture": {"index": number}}})
        content["textures"].append(
            {"source": 0, **({} if name is None else {"sampler": len(content["samplers"])})}
        )
        if name is not None:
            content["samplers"].append({"wrapS": NUMBERS[name], "wrapT": NUMBERS[name], "magFilter": 9728})
    file = write_scene(tmp_path, content, [CORNERS, (reach * UV).astype("<f4"), ORDER, arrays[3]])
    if wanted is None:
        with pytest.raises(
            DataError, match=r"one\.glb: the textures of the scene continue .*\(clamp, mirror\), but a scene"
        ):
            read(file)
        return
    texture = read(file).scene.texture
    assert texture is not None and texture.wrap == wanted
    assert texture.smooth == (None in samplers and len(samplers) == 1)
    assert len(texture.images) == len(samplers) and texture.shown is not None
    assert texture.shown.tolist() == [number for number in range(len(samplers)) for _ in range(2)]


def test_the_same_mesh_as_obj_and_glb_is_the_same_scene(tmp_path: Path) -> None:
    """Compare files that trimesh writes in both formats: corners, texture coordinates, linear RGB."""
    mesh = trimesh.creation.box((1, 2, 3))
    mesh.unmerge_vertices()
    uv = np.random.default_rng(2).uniform(0, 1, (len(mesh.vertices), 2))
    mesh.visual = trimesh.visual.TextureVisuals(uv, image=Image.fromarray(FOUR))
    mesh.export(tmp_path / "one.glb")
    mesh.export(tmp_path / "one.obj")
    shapes = []
    for name in ("one.glb", "one.obj"):
        scene = read(tmp_path / name).scene
        assert scene.texture is not None and scene.colors is not None
        np.testing.assert_allclose(scene.texture.images[0], to_linear(FOUR), atol=1e-6)
        corners = [scene.vertices[scene.faces], scene.texture.uv[scene.texture.faces]]
        shapes.append(torch.cat([*(values.flatten(1).double() for values in corners)], 1))
    np.testing.assert_allclose(shapes[0].sort(0).values, shapes[1].sort(0).values, atol=1e-5)


def test_an_obj_has_the_colours_of_its_materials(tmp_path: Path) -> None:
    """Check splitting by material, relative indices and uv per corner; a missing file only adds a note."""
    (tmp_path / "one.obj").write_bytes(OBJ)
    without = read(tmp_path / "one.obj")
    assert without.scene.texture is None and len(without.notes) == 1 and "one.mtl" in without.notes[0]
    (tmp_path / "one.mtl").write_bytes(MTL.replace(b"-clamp on ", b""))
    assert "one.png" in read(tmp_path / "one.obj").notes[0]
    (tmp_path / "one.png").write_bytes(png(FOUR))
    subject = read(tmp_path / "one.obj")
    scene = subject.scene
    assert not subject.notes and scene.texture is not None and scene.colors is not None
    stored = to_linear(np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]))
    for face, factor in ((0, [1, 0, 0]), (1, [0, 0, 1])):
        for corner in range(3):
            place = scene.vertices[scene.faces[face, corner]][:2].int().tolist()
            vertex = [[0, 0], [1, 0], [1, 1], [0, 1]].index(place)
            np.testing.assert_allclose(
                scene.colors[scene.faces[face, corner]], stored[vertex] * factor, atol=1e-6
            )
            np.testing.assert_allclose(
                texel_at_corner(scene, face, corner), to_linear(FOUR[1 - place[1], place[0]]), atol=1e-6
            )


NAMES = ("#ff0000", "wall #1", "wall #2", "a#", "##", "plain", "wall", "two  blanks #", "#")
LIBRARIES = ("my#1.mtl", "#.mtl", "two words #2.mtl", "one.mtl")
PICTURES = ("a#b.png", "#c.png", "d #2.png")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("before", ["", " ", "\t"])
@pytest.mark.parametrize("library", LIBRARIES)
def test_names_may_contain_the_comment_sign(tmp_path: Path, library: str, before: str, end: str) -> None:
    """Check a triangle of each material in files with comments: colours as trimesh reads them, textures as written."""
    random = np.random.default_rng(0)
    behind = "# a comment" if before else ""  # trimesh supports neither such comments nor leading blanks
    colors = random.uniform(0, 1, (len(NAMES), 3)).round(3)
    images = random.integers(0, 256, (len(PICTURES), 2, 2, 3)).astype(np.uint8)
    surface, materials = ["#comment", "# usemtl wall", f"mtllib {library}"], ["# newmtl wall"]
    for number, (name, color) in enumerate(zip(NAMES, colors, strict=True)):
        surface += [f"v {number} {x} {y}{behind}" for x, y in ((0, 0), (1, 0), (0, 1))]
        corners = [3 * number + corner + 1 for corner in range(3)]
        surface += [f"vt 0.5 0.5{behind}", f"usemtl {name}"]
        surface += ["f " + " ".join(f"{corner}/{number + 1}" for corner in corners) + behind]
        materials += [f"newmtl {name}", "Kd {} {} {} ".format(*color) + behind]
        if number < len(PICTURES):
            materials += [f"map_Kd {PICTURES[number]}"]
            (tmp_path / PICTURES[number]).write_bytes(png(images[number]))
    file = tmp_path / "one.obj"
    for place, lines in ((file, surface), (tmp_path / library, materials)):
        place.write_bytes(end.join(before + line for line in [*lines, ""]).encode())
    subject = read(file)
    scene = subject.scene
    assert not subject.notes and scene.colors is not None and scene.texture is not None
    assert len(scene.texture.images) == len(PICTURES) and scene.texture.shown is not None
    for number, color in enumerate(colors):
        (face,) = (scene.vertices[scene.faces][:, 0, 0] == number).nonzero()[:, 0].tolist()
        np.testing.assert_allclose(scene.colors[scene.faces[face]], np.tile(color, (3, 1)), atol=1e-6)
        shown = int(scene.texture.shown[face])
        assert (shown >= 0) == (number < len(PICTURES))
        if shown >= 0:
            np.testing.assert_allclose(scene.texture.images[shown], to_linear(images[number]), atol=1e-6)
    if before:
        return
    reference = trimesh.load(file, process=False, group_material=True)
    assert isinstance(reference, trimesh.Scene)
    for mesh in reference.geometry.values():
        number = round(float(mesh.vertices[0, 0]))
        if "  " not in NAMES[number]:  # trimesh reads two blanks as one in one of the two files
            np.testing.assert_allclose(mesh.visual.material.diffuse[:3] / 255, colors[number], atol=1 / 255)


@pytest.mark.parametrize("binary", [False, True])
def test_ply_colours_become_linear_rgb_and_the_texture_is_found(tmp_path: Path, binary: bool) -> None:
    colors = np.array([[255, 128, 0, 255], [12, 55, 99, 255], [1, 2, 3, 255], [200, 100, 50, 255]], np.uint8)
    mesh = trimesh.Trimesh(CORNERS, ORDER.reshape(2, 3), vertex_colors=colors, process=False)
    mesh.export(tmp_path / "one.ply", encoding="binary" if binary else "ascii")
    subject = read(tmp_path / "one.ply")
    assert subject.scene.colors is not None and not subject.plain.any() and subject.up == "y"
    np.testing.assert_allclose(subject.scene.colors, to_linear(colors[:, :3]), atol=1e-6)
    head = "ply\nformat ascii 1.0\ncomment TextureFile one.png\nelement vertex 4\n"
    head += "".join(f"property float {name}\n" for name in "xyzst") + "element face 2\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    rows = "".join(f"{x} {y} {z} {x} {y}\n" for x, y, z in CORNERS.tolist()) + "3 0 1 2\n3 0 2 3\n"
    (tmp_path / "two.ply").write_text(head + rows)
    assert "one.png is missing in the scene's folder" in read(tmp_path / "two.ply").notes[0]
    (tmp_path / "one.png").write_bytes(png(FOUR))
    scene = read(tmp_path / "two.ply").scene
    np.testing.assert_allclose(texel_at_corner(scene, 0, 0), to_linear(FOUR[1, 0]), atol=1e-6)
    np.testing.assert_allclose(texel_at_corner(scene, 1, 2), to_linear(FOUR[0, 0]), atol=1e-6)


def write_formats(folder: Path, name: str) -> list[Path]:
    """Write a scene in each format whose texture has this name, and return the paths."""
    content, arrays = textured_square()
    content["images"] = [{"uri": name}]
    (folder / "one.obj").write_bytes(OBJ)
    (folder / "one.mtl").write_bytes(b"newmtl red\nmap_Kd " + name.encode())
    head = f"ply\nformat ascii 1.0\ncomment TextureFile {name}\nelement vertex 3\n"
    head += "".join(f"property float {axis}\n" for axis in "xyzst") + "element face 1\n"
    head += (
        "property list uchar int vertex_indices\nend_header\n" + "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n3 0 1 2\n"
    )
    (folder / "one.ply").write_text(head)
    files = [write_scene(folder, content, arrays, end) for end in ("one.glb", "one.gltf")]
    return [*files, folder / "one.obj", folder / "one.ply"]


def test_texture_names_that_are_not_utf8_are_found(tmp_path: Path) -> None:
    (tmp_path / os.fsdecode(b"caf\xe9.png")).write_bytes(png(FOUR))
    for file in write_formats(tmp_path, "caf%E9.png"):
        if file.suffix in (".obj", ".ply"):
            named = (tmp_path / "one.mtl") if file.suffix == ".obj" else file
            named.write_bytes(named.read_bytes().replace(b"caf%E9", b"caf\xe9"))
        subject = read(file)
        assert subject.scene.texture is not None and not subject.notes


@pytest.mark.parametrize(
    "name",
    ["../one.png", "/etc/hostname", "http://localhost/x.png", "sub/../../one.png", "..", "C:\\"],
)
def test_no_file_outside_of_the_folder_is_read(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "inner"
    (folder / "sub").mkdir(parents=True)
    (tmp_path / "one.png").write_bytes(png(FOUR))
    (folder / "link").symlink_to(tmp_path / "one.png")
    for file in write_formats(folder, name):
        subject = read(file)
        assert subject.scene.texture is None
        assert subject.notes == (
            f"the texture is in another folder, {name}, which is not read; the scene is drawn without this file.",
        )
    for file in write_formats(folder, "link"):
        with pytest.raises(
            DataError, match=r"inner.*the file refers to 'link', but only files in the same folder"
        ):
            read(file)
    buffers, arrays = textured_square()
    file = write_scene(
        folder, buffers, arrays, "one.gltf", lambda whole: whole["buffers"][0].update(uri=name)
    )
    with pytest.raises(DataError, match=r"inner.*the file refers to .*, but only files in the same folder"):
        read(file)


@pytest.mark.parametrize(
    "name",
    [
        *(
            "C:\\Users\\me\\t.png",
            "C:/t.png",
            "/home/me/t.png",
            "../t.png",
            "..\\maps\\t.png",
            "file:///D:/t.png",
        )
    ],
)
def test_a_path_in_another_folder_is_replaced_by_the_file_beside_the_scene(tmp_path: Path, name: str) -> None:
    (tmp_path / "t.png").write_bytes(png(FOUR))
    (tmp_path / "one.mtl").write_bytes(b"newmtl red\nmap_Kd t.png")
    for file in write_formats(tmp_path, name):
        subject = read(file)
        assert subject.scene.texture is not None
        assert subject.notes == (
            f"the texture is in another folder, {name}; t.png in the scene's folder is read instead.",
        )
    (tmp_path / "t.png").rename(tmp_path / "lib.mtl")
    library = f"mtllib {name.replace('t.png', 'lib.mtl')}\n".encode()
    (tmp_path / "one.obj").write_bytes(library + OBJ.partition(b"\n")[2])
    (tmp_path / "lib.mtl").write_bytes(b"newmtl red\nKd 1 0 0\n")
    subject = read(tmp_path / "one.obj")
    assert subject.notes == (
        f"the materials are in another folder, {name.replace('t.png', 'lib.mtl')}; lib.mtl in the scene's folder is "
        "read instead.",
    )


def test_every_format_notes_a_missing_texture_in_the_same_words(tmp_path: Path) -> None:
    for file in write_formats(tmp_path, "sub/gone.png"):
        subject = read(file)
        assert subject.scene.texture is None
        assert subject.notes == (
            "the texture sub/gone.png is missing in the scene's folder; the scene is drawn without this file.",
        )
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "gone.png").write_bytes(png(FOUR))
    for file in write_formats(tmp_path, "sub/gone.png"):
        subject = read(file)
        assert subject.scene.texture is not None and not subject.notes


LEFT_OUT: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "instances": (
        lambda whole: whole.update(extensionsUsed=["EXT_mesh_gpu_instancing", "KHR_materials_ior"]),
        "the file uses EXT_mesh_gpu_instancing, which is not supported; its additions are left out.",
    ),
    "a texture of an extension": (
        lambda whole: whole.update(textures=[{"extensions": {"KHR_texture_basisu": {"source": 0}}}]),
        "a texture is stored by an unsupported extension, so the texture is left out.",
    ),
    "scenes": (
        lambda whole: whole.update(scenes=[{"nodes": [0]}, {"nodes": []}]),
        "the file's other scenes are left out.",
    ),
    "alpha": (
        lambda whole: whole["materials"][0].update(alphaMode="BLEND"),
        "transparency is left out.",
    ),
    "blend shapes": (lambda whole: whole["meshes"][0].update(weights=[1]), "the blend shapes are left out."),
}


@pytest.mark.parametrize("kind", LEFT_OUT)
def test_elements_that_a_scene_leaves_out_are_noted(tmp_path: Path, kind: str) -> None:
    change, note = LEFT_OUT[kind]
    assert not read(write_scene(tmp_path, *textured_square())).notes
    assert read(write_scene(tmp_path, *textured_square(), change=change)).notes == (note,)


def test_the_total_size_of_textures_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content, arrays = textured_square()
    file = write_scene(tmp_path, content, arrays)
    monkeypatch.setattr(parts, "MOST_TEXELS", 3)
    with pytest.raises(
        DataError, match=r"one\.glb: the texture 0: the image has 2 x 2 pixels, but .* Make the image smaller"
    ):
        read(file)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            lambda whole: whole.update(extensionsRequired=["KHR_draco_mesh_compression"]),
            "the file requires KHR_draco",
        ),
        (lambda whole: whole["asset"].update(version="1.0"), "the file has glTF version '1.0'"),
        (
            lambda whole: whole["meshes"][0]["primitives"][0].update(mode=0),
            "the file has no faces, only points",
        ),
        (lambda whole: whole["nodes"][0].update(children=[0]), "node 0 of the glTF file has two parents"),
        (
            lambda whole: whole["nodes"][0].update(mesh=7),
            "the glTF file refers to entry 7 of `meshes`, which has 1",
        ),
        (
            lambda whole: whole["nodes"][0].update(translation=[1e400, 0, 0]),
            "a coordinate of the scene is not finite",
        ),
        (
            lambda whole: whole["accessors"][0].update(count=10**9),
            "the file refers to the same data too often, or is damaged",
        ),
        (
            lambda whole: whole["accessors"][0].update(count=3),
            "refers to vertex 3, but the vertices are numbered 0 to 2",
        ),
        (lambda whole: whole["accessors"][0].pop("count"), "the key 'count' is missing"),
        (lambda whole: whole["bufferViews"][0].update(byteLength=10**9), "the file is cut short"),
        (
            lambda whole: whole["textures"][0].update(source=-1),
            "the glTF file refers to entry -1 of `images`",
        ),
        (
            lambda whole: (
                whole["accessors"][0].pop("bufferView"),
                whole["meshes"][0]["primitives"][0].update(extensions={"KHR_draco_mesh_compression": {}}),
            ),
            "the vertices of the glTF file are stored only by KHR_draco_mesh_compression",
        ),
        (
            lambda whole: (
                whole["buffers"].append({"byteLength": 48, "extensions": {"EXT_meshopt_compression": {}}}),
                whole["bufferViews"][0].update(buffer=1),
            ),
            "the data of buffer 1 are missing in the glTF file; they are stored by EXT_meshopt_compression",
        ),
    ],
)
def test_a_bad_gltf_raises_a_clear_message(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], sentence: str
) -> None:
    for name in ("one.glb", "one.gltf"):
        file = write_scene(tmp_path, *textured_square(), name=name, change=change)
        with pytest.raises(DataError) as caught:
            read(file)
        assert str(caught.value).startswith(f"{file}: ") and sentence in str(caught.value)


def test_truncated_files_raise_an_error(tmp_path: Path) -> None:
    """Check that a .glb cut anywhere is refused; `tests/fuzz/fuzz.py` tests other damage."""
    whole = glb(*quad())
    file = tmp_path / "one.glb"
    for end in range(0, len(whole), 29):
        file.write_bytes(whole[:end])
        with pytest.raises(DataError, match=r"one\.glb: "):
            read(file)


def test_files_that_are_no_scene_raise_a_clear_message(tmp_path: Path) -> None:
    (tmp_path / "chair.glb").mkdir()
    (tmp_path / "points.ply").write_bytes(trimesh.PointCloud(CORNERS).export(file_type="ply"))
    for name, sentence in (
        (
            "chiar.glb",
            "the file does not exist. Correct the path of the scene file. Did you mean 'chair.glb'?",
        ),
        ("chair.glb", "is a folder. Give a file whose name ends in .glb, .gltf"),
        (
            "chair.gbl",
            "Give a file whose name ends in .glb, .gltf, .obj, .off, .ply, .stl. Did you mean '.glb'?",
        ),
        ("points.ply", "the file has no faces, only points or lines, but a surface is required"),
    ):
        with pytest.raises(DataError) as caught:
            read(tmp_path / name)
        assert sentence in str(caught.value) and str(tmp_path / name) in str(caught.value)


@pytest.mark.skipif(not REAL, reason="REAL_DATA_ROOT is not set")
def test_real_files_are_read_as_trimesh_reads_them() -> None:
    assert REAL
    man = Path(REAL, "bodies", "CesiumMan.glb")
    scene, reference = read(man).scene, trimesh.load(man, force="mesh", process=False)
    ours, theirs = scene.vertices[scene.faces].numpy(), reference.vertices[reference.faces]
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert scene.texture is not None
    wanted = reference.visual.uv[reference.faces]
    np.testing.assert_allclose(scene.texture.uv[scene.texture.faces], wanted, atol=1e-6)
    for file in sorted(Path(REAL, "meshes").iterdir()):
        if file.suffix.lower() not in UPWARDS:
            continue
        try:
            scene = read(file).scene
        except DataError as error:
            assert str(file) in str(error)
            continue
        reference = trimesh.load(file, force="mesh", process=False)
        ours, theirs = scene.vertices[scene.faces].mean(1), reference.vertices[reference.faces].mean(1)
        np.testing.assert_allclose(ours.sort(0).values, np.sort(theirs, 0), atol=1e-5)
