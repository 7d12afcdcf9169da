"""Reader of glTF 2.0 (Khronos, 2021) files, .gltf and .glb: surfaces, base colours and positions.

Other material properties, animations, lights and cameras are not read.
The package trimesh is not used, because it reads 70 of 124 valid test files as another scene or not at all (version
5.2.0; see docs/reference/files.md).
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from framework.errors import DataError, quote, shorten
from framework.renderer import Wrap
from framework.scenes.gltf_document import (
    WIDTHS,
    Document,
    open_document,
    to_numbers,
    whole_number,
)
from framework.scenes.parts import NO_COORDINATES, Part, Subject, find_beside, join_parts
from framework.storage.limits import MOST_JOINT_SETS, MOST_PARTS
from framework.storage.reading import translate_errors

WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
SUPPORTED = (
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_",  # all of them change how light is reflected
    "KHR_mesh_quantization",
    "KHR_texture_transform",
)
"""Names, or beginnings of names, of the extensions that a file may require."""
MOVES = {"matrix", "rotation", "scale", "translation"}
POINTS_AND_LINES, TRIANGLES, STRIP, FAN = (0, 1, 2, 3), 4, 5, 6


def read(file: Path) -> Subject:
    """Read the surfaces of a glTF file's scene with their base colours.

    Raises:
        DataError: the file or a file that it refers to is missing or damaged; or the file is not glTF 2.0, requires an
            unsupported extension, or has no surface.
    """
    # overflow gives numbers that are not finite; `join_parts` raises an error for them
    with translate_errors(file, "glTF"), np.errstate(all="ignore"):
        document = open_document(file)
        version = str(document.content["asset"]["version"])
        if not version.startswith("2."):
            raise ValueError(f"the file has glTF version {quote(version)}, but only 2.0 is supported")
        if required := _find_unsupported(document, "extensionsRequired"):
            raise DataError(
                f"{file}: the file requires {shorten(', '.join(required))}, which is not supported. Save the file "
                "without this extension, e.g. with neither compressed geometry nor compressed textures."
            )
        if used := _find_unsupported(document, "extensionsUsed"):
            document.notes.append(
                f"the file uses {shorten(', '.join(used))}, which is not supported; its additions are left out."
            )
        if len(document.content.get("scenes", ())) > 1:
            document.notes.append("the file's other scenes are left out.")
        try:
            parents = _find_parents(document)
            if _count_parts(document, parents) > MOST_PARTS:
                raise DataError(
                    f"{file}: the scene has more than {MOST_PARTS} parts. Join some of them into one mesh."
                )
            parts = list(_read_parts(document, parents))
        except KeyError as error:
            raise ValueError(
                f"in the description of the glTF file, the key {shorten(error)} is missing, or the value "
                f"{shorten(error)} is not allowed"
            ) from error
        return join_parts(parts, "y", document.notes)


def _find_unsupported(document: Document, key: str) -> list[str]:
    """Return the unsupported extensions among those that the file lists under `key`."""
    return [name for name in document.content.get(key, ()) if not name.startswith(SUPPORTED)]


def _count_parts(document: Document, shown_nodes: Iterable[int]) -> int:
    """Return the number of parts (primitives of meshes) that these nodes show, without reading any part."""
    nodes = (document.item("nodes", number) for number in shown_nodes)
    return sum(len(document.item("meshes", node["mesh"])["primitives"]) for node in nodes if "mesh" in node)


def _read_parts(document: Document, parents: dict[int, int | None]) -> Iterator[Part]:
    """Yield the parts in the scene's axes; a mesh that several nodes refer to is yielded once for each node."""
    matrices = _node_matrices(document, parents)
    known: dict[tuple[int, int], Part] = {}
    needed = 0
    for number, matrix in matrices.items():
        node = document.item("nodes", number)
        if "mesh" not in node:
            continue
        mesh = document.item("meshes", node["mesh"])
        if any(mesh.get("weights", ())) or any(node.get("weights", ())):
            document.notes.append("the blend shapes are left out.")
        for place_in_mesh, primitive in enumerate(mesh["primitives"]):
            if whole_number(primitive.get("mode", TRIANGLES)) in POINTS_AND_LINES:
                document.notes.append("points and lines are left out.")
                continue
            key = (node["mesh"], place_in_mesh)
            part = known[key] = known.get(key) or _read_part(document, primitive)
            needed += 80 * (len(part.vertices) + len(part.faces))
            document.check_size(needed)
            if "skin" in node:
                yield _pose_part(document, part, primitive, document.item("skins", node["skin"]), matrices)
            else:
                yield _transform_part(part, matrix)


def _find_parents(document: Document) -> dict[int, int | None]:
    """Return each node of the scene with its parent (None for a root); parents precede their children."""
    scenes = document.content.get("scenes", [])
    if scenes:
        roots = document.item("scenes", document.content.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in document.content.get("nodes", []) for child in node.get("children", [])}
        roots = [number for number in range(len(document.content.get("nodes", []))) if number not in children]
    parents_of: dict[int, int | None] = {}
    waiting: list[tuple[int, int | None]] = [(number, None) for number in roots]
    while waiting:
        number, parent = waiting.pop()
        node = document.item("nodes", number)
        if number in parents_of:
            raise ValueError(
                f"node {number} of the glTF file has two parents, or is its own ancestor; expected a tree of nodes"
            )
        parents_of[number] = parent
        waiting += [(child, number) for child in reversed(node.get("children", []))]
    return parents_of


def _node_matrices(document: Document, parents: dict[int, int | None]) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return for each node the matrix from the node's own axes to the scene's axes."""
    matrices: dict[int, NDArray] = {}
    for number, parent in parents.items():
        matrix = np.eye(4) if parent is None else matrices[parent]
        node = document.item("nodes", number)
        matrices[number] = matrix @ _transform(node) if MOVES & node.keys() else matrix
    return matrices


def _transform(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Return the matrix of a node relative to its parent: the stored one, or translation · rotation · scale (3.5.3)."""
    if "matrix" in node:
        return to_numbers(node["matrix"]).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = to_numbers(node.get("rotation", (0, 0, 0, 1)))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix[:3, :3] = rotation * to_numbers(node.get("scale", (1, 1, 1))).reshape(3)
    matrix[:3, 3] = to_numbers(node.get("translation", (0, 0, 0))).reshape(3)
    return matrix


def _transform_part(part: Part, matrix: Float[np.ndarray, "4 4"]) -> Part:
    vertices = part.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    mirrored = np.linalg.det(matrix[:3, :3]) < 0  # section 3.7.4: the winding order is then reversed
    return replace(part, vertices=vertices, faces=part.faces[:, ::-1] if mirrored else part.faces)


def _pose_part(
    document: Document,
    part: Part,
    primitive: dict[str, Any],
    skin: dict[str, Any],
    matrices: dict[int, NDArray],
) -> Part:
    """Return a part in the rest pose of its joints; the node's own matrix is ignored (section 3.7.3.3)."""
    document.notes.append("the model is drawn in its rest pose.")
    joints = np.stack([matrices[number] for number in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = document.numbers(skin["inverseBindMatrices"], 16).reshape(-1, 4, 4).mT
        joints = joints @ inverse[: len(joints)]
    posed = np.zeros_like(part.vertices)
    attributes = primitive["attributes"]
    ones = np.ones((len(part.vertices), 1))
    sets = sum(name.startswith("JOINTS_") for name in attributes)
    if sets > MOST_JOINT_SETS:
        raise ValueError(
            f"a part of the glTF file has {4 * sets} joints at each vertex, but at most {4 * MOST_JOINT_SETS} are "
            "supported"
        )
    for number in range(sets):
        joint_numbers = document.numbers(attributes[f"JOINTS_{number}"], 4)
        weights = document.numbers(attributes[f"WEIGHTS_{number}"], 4, shares=True)
        for corner in range(4):
            vertex_joints = joints[joint_numbers[:, corner], :3]
            document.check_size(vertex_joints.nbytes)
            transformed = np.einsum("vij,vj->vi", vertex_joints, np.concatenate([part.vertices, ones], 1))
            posed += weights[:, corner, None] * transformed
    return replace(part, vertices=posed)


def _read_part(document: Document, primitive: dict[str, Any]) -> Part:
    attributes = primitive["attributes"]
    positions = document.item("accessors", attributes["POSITION"])
    if "extensions" in primitive and not {"bufferView", "sparse"} & positions.keys():
        raise DataError(
            f"the vertices of the glTF file are stored only by {shorten(', '.join(primitive['extensions']))}, which "
            "is not supported. Save the file without compression."
        )
    vertices = document.numbers(attributes["POSITION"], 3).astype(np.float64)
    count = len(vertices)
    order = np.arange(count)
    if "indices" in primitive:
        order = document.numbers(primitive["indices"], 1)[:, 0].astype(np.int64)
    if order.size and order.max() >= count:
        raise ValueError(
            f"a face of the glTF file refers to vertex {order.max()}, but the vertices are numbered 0 to {count - 1}"
        )
    faces = _read_triangles(order, primitive.get("mode", TRIANGLES))
    factor, texture = _read_material(document, primitive)
    colors = None if factor is None else np.tile(factor, (count, 1))
    if "COLOR_0" in attributes:
        width = WIDTHS[document.item("accessors", attributes["COLOR_0"])["type"]]
        stored = document.numbers(attributes["COLOR_0"], width, shares=True)
        own = _check_count(stored, count, "colour")[:, :3]
        colors = own if colors is None else own * colors
    part = Part(vertices, faces, colors)
    return part if texture is None else _add_texture(document, part, attributes, texture)


def _check_count(values: NDArray, count: int, quantity: str) -> NDArray:
    if len(values) != count:
        raise ValueError(
            f"the glTF file has {len(values)} values of {quantity} for {count} vertices; expected one value per "
            "vertex"
        )
    return values


def _read_triangles(order: Int[np.ndarray, "corners"], mode: Any) -> Int[np.ndarray, "faces 3"]:
    """Return the triangles of a primitive from its vertex indices and its mode (equations of section 3.7.2.1)."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    inner = np.arange(max(len(order) - 2, 0))
    if mode == STRIP:
        return order[np.stack([inner, inner + 1 + inner % 2, inner + 2 - inner % 2], 1)]
    if mode == FAN:
        return order[np.stack([inner + 1, inner + 2, np.zeros_like(inner)], 1)]
    raise ValueError(
        f"the mode of a primitive of the glTF file is {quote(mode)}; expected 4, 5 or 6 (triangles, strip, fan)"
    )


def _read_material(
    document: Document, primitive: dict[str, Any]
) -> tuple[Float[np.ndarray, "3"] | None, dict[str, Any] | None]:
    """Return the base colour factor (None for no factor) and the reference to the texture (None for no texture)."""
    if "material" not in primitive:
        return None, None
    material = document.item("materials", primitive["material"])
    if material.get("alphaMode", "OPAQUE") != "OPAQUE":
        document.notes.append("transparency is left out.")
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if glossy is not None:
        factor, texture = glossy.get("diffuseFactor"), glossy.get("diffuseTexture")
    else:
        metallic = material.get("pbrMetallicRoughness", {})
        factor, texture = metallic.get("baseColorFactor"), metallic.get("baseColorTexture")
    if factor is None:
        return None, texture
    base_color = to_numbers(factor).reshape(-1)[:3]
    return (None if base_color.tolist() == [1, 1, 1] else base_color), texture


def _add_texture(
    document: Document, part: Part, attributes: dict[str, Any], reference: dict[str, Any]
) -> Part:
    transform = reference.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{whole_number(transform.get('texCoord', reference.get('texCoord', 0)))}"
    if name not in attributes:
        document.notes.append(NO_COORDINATES)
        return part
    stored = document.numbers(attributes[name], 2)
    uv = _check_count(stored, len(part.vertices), "texture coordinate").astype(np.float64)
    if transform:
        # KHR_texture_transform: translation · rotation · scale, counter-clockwise for v downwards. The text of the
        # extension and its test model agree; its GLSL code rotates the other way (KhronosGroup/glTF issue 1563).
        angle = float(to_numbers(transform.get("rotation", 0)))
        rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        uv = (uv * to_numbers(transform.get("scale", (1, 1)))) @ rotation.T
        uv = uv + to_numbers(transform.get("offset", (0, 0)))
    texture = document.item("textures", reference["index"])
    image = _read_image(document, texture)
    if image is None:
        return part
    sampler = document.item("samplers", texture["sampler"]) if "sampler" in texture else {}
    wraps = WRAPS[sampler.get("wrapS", 10497)], WRAPS[sampler.get("wrapT", 10497)]
    return replace(
        part,
        image=image,
        uv=np.stack([uv[:, 0], 1 - uv[:, 1]], 1),  # glTF's v runs downwards
        wraps=wraps,
        smooth=sampler.get("magFilter") != NEAREST,
    )


def _read_image(document: Document, texture: dict[str, Any]):
    number = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source", texture.get("source"))
    if number is None:
        document.notes.append("a texture is stored by an unsupported extension, so the texture is left out.")
        return None
    image = document.item("images", number)
    known = document.textures.find(number)
    if known is not None:
        return known
    uri = image.get("uri")
    if uri is not None and not uri.startswith("data:"):
        file = find_beside(
            document.folder, unquote(uri, errors="surrogateescape"), "texture is", document.notes
        )
        if file is None:
            return None
        content, name = document.read_file(file), shorten(uri, 60)
    elif uri is not None:
        content, name = document.read_address(uri), shorten(uri, 60)
    else:
        content, name = bytes(document.buffer_view(image["bufferView"])[0]), f"{number}"
    return document.textures.decode(number, content, name)
