"""Reader of glTF 2.0 (Khronos, 2021) files, .gltf and .glb: surfaces, base colours and positions.

Light that materials reflect, animations and cameras are not read.
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
from framework.storage.limits import MOST_JOINT_SETS, MOST_PARTS
from framework.storage.reading import translate_errors
from plugins.renderer.rasterizer.gltf_document import WIDTHS, Document, numbers, opened, whole
from plugins.renderer.rasterizer.parts import Part, Subject, drawn_without, subject

WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = 9728
UNDERSTOOD = (
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_",  # all of them change how light is reflected
    "KHR_mesh_quantization",
    "KHR_texture_transform",
)
"""Extensions that a file may require, or the beginnings of their names."""
MOVES = {"matrix", "rotation", "scale", "translation"}
POINTS_AND_LINES, TRIANGLES, STRIP, FAN = (0, 1, 2, 3), 4, 5, 6


def read(file: Path) -> Subject:
    """Return the surfaces of a file's scene, in base colours.

    Raises:
        DataError: the file, or a file that it refers to, is missing, damaged or no glTF 2.0, needs an extension that is
            not understood, or shows no surface.
    """
    # overflow gives numbers that are not finite, which are refused at the end
    with translate_errors(file, "glTF"), np.errstate(all="ignore"):
        document = opened(file)
        version = str(document.content["asset"]["version"])
        if not version.startswith("2."):
            raise ValueError(f"it is of version {quote(version)}; wanted 2.0")
        missing = [
            one for one in document.content.get("extensionsRequired", ()) if not one.startswith(UNDERSTOOD)
        ]
        if missing:
            raise DataError(
                f"{file}: it needs {shorten(', '.join(missing))}, which is not understood; save it without, e.g. with "
                "neither compressed geometry nor compressed textures."
            )
        unknown = [
            one for one in document.content.get("extensionsUsed", ()) if not one.startswith(UNDERSTOOD)
        ]
        if unknown:
            document.notes.append(
                f"it uses {shorten(', '.join(unknown))}, which is not understood: what that adds is left out."
            )
        if len(document.content.get("scenes", ())) > 1:
            document.notes.append("its other scenes are left out.")
        try:
            above = _above(document)
            if _count(document, above) > MOST_PARTS:
                raise DataError(
                    f"{file}: it has more than {MOST_PARTS} parts; join some of them in one mesh."
                )
            parts = list(_parts(document, above))
        except KeyError as error:
            raise ValueError(f"{shorten(error)} is missing, or none of what may stand there") from error
        return subject(parts, "y", document.notes)


def _count(document: Document, shown_nodes: Iterable[int]) -> int:
    """Return how many parts these nodes show, before any of them is read or placed."""
    nodes = (document.item("nodes", number) for number in shown_nodes)
    return sum(len(document.item("meshes", node["mesh"])["primitives"]) for node in nodes if "mesh" in node)


def _parts(document: Document, above: dict[int, int | None]) -> Iterator[Part]:
    """Yield the parts where their nodes stand; a mesh that several nodes show is yielded for each."""
    places = _places(document, above)
    known: dict[tuple[int, int], Part] = {}
    needed = 0
    for number, place in places.items():
        node = document.item("nodes", number)
        if "mesh" not in node:
            continue
        mesh = document.item("meshes", node["mesh"])
        if any(mesh.get("weights", ())) or any(node.get("weights", ())):
            document.notes.append("its blend shapes are left out.")
        for place_in_mesh, primitive in enumerate(mesh["primitives"]):
            if whole(primitive.get("mode", TRIANGLES)) in POINTS_AND_LINES:
                document.notes.append("its points and lines are left out.")
                continue
            key = (node["mesh"], place_in_mesh)
            part = known[key] = known.get(key) or _part(document, primitive)
            needed += 80 * (len(part.vertices) + len(part.faces))
            document.bounded(needed)
            if "skin" in node:
                yield _skinned(document, part, primitive, document.item("skins", node["skin"]), places)
            else:
                yield _placed(part, place)


def _above(document: Document) -> dict[int, int | None]:
    """Return the nodes that the scene shows with their parent nodes; each node comes after its parent."""
    scenes = document.content.get("scenes", [])
    if scenes:
        roots = document.item("scenes", document.content.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in document.content.get("nodes", []) for child in node.get("children", [])}
        roots = [number for number in range(len(document.content.get("nodes", []))) if number not in children]
    found: dict[int, int | None] = {}
    waiting: list[tuple[int, int | None]] = [(number, None) for number in roots]
    while waiting:
        number, above = waiting.pop()
        node = document.item("nodes", number)
        if number in found:
            raise ValueError(f"its node {number} stands in two places, or in itself")
        found[number] = above
        waiting += [(child, number) for child in reversed(node.get("children", []))]
    return found


def _places(document: Document, above: dict[int, int | None]) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Return the matrices from each node's own axes to the scene's axes."""
    found: dict[int, NDArray] = {}
    for number, parent in above.items():
        place = np.eye(4) if parent is None else found[parent]
        node = document.item("nodes", number)
        found[number] = place @ _transform(node) if MOVES & node.keys() else place
    return found


def _transform(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Return a node's matrix, or translation · rotation · scale (section 3.5.3)."""
    if "matrix" in node:
        return numbers(node["matrix"]).reshape(4, 4).T
    found = np.eye(4)
    x, y, z, w = numbers(node.get("rotation", (0, 0, 0, 1)))
    turned = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    found[:3, :3] = turned * numbers(node.get("scale", (1, 1, 1))).reshape(3)
    found[:3, 3] = numbers(node.get("translation", (0, 0, 0))).reshape(3)
    return found


def _placed(part: Part, place: Float[np.ndarray, "4 4"]) -> Part:
    vertices = part.vertices @ place[:3, :3].T + place[:3, 3]
    mirrored = np.linalg.det(place[:3, :3]) < 0  # section 3.7.4: the winding order is then reversed
    return replace(part, vertices=vertices, faces=part.faces[:, ::-1] if mirrored else part.faces)


def _skinned(
    document: Document,
    part: Part,
    primitive: dict[str, Any],
    skin: dict[str, Any],
    places: dict[int, NDArray],
) -> Part:
    """Return a part posed by its joints without an animation; the node's own position is ignored (section 3.7.3.3)."""
    document.notes.append("it is shown in its rest pose.")
    joints = np.stack([places[number] for number in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = document.numbers(skin["inverseBindMatrices"], 16).reshape(-1, 4, 4).mT
        joints = joints @ inverse[: len(joints)]
    moved = np.zeros_like(part.vertices)
    attributes = primitive["attributes"]
    ones = np.ones((len(part.vertices), 1))
    sets = sum(name.startswith("JOINTS_") for name in attributes)
    if sets > MOST_JOINT_SETS:
        raise ValueError(
            f"a part follows {4 * sets} joints at each vertex; wanted at most {4 * MOST_JOINT_SETS}"
        )
    for number in range(sets):
        chosen = document.numbers(attributes[f"JOINTS_{number}"], 4)
        weights = document.numbers(attributes[f"WEIGHTS_{number}"], 4, shares=True)
        for corner in range(4):
            of_vertices = joints[chosen[:, corner], :3]
            document.bounded(of_vertices.nbytes)
            here = np.einsum("vij,vj->vi", of_vertices, np.concatenate([part.vertices, ones], 1))
            moved += weights[:, corner, None] * here
    return replace(part, vertices=moved)


def _part(document: Document, primitive: dict[str, Any]) -> Part:
    attributes = primitive["attributes"]
    described = document.item("accessors", attributes["POSITION"])
    if "extensions" in primitive and not {"bufferView", "sparse"} & described.keys():
        raise DataError(
            f"its vertices are stored by {shorten(', '.join(primitive['extensions']))} alone, which is not understood; "
            "wanted them without compression. Save it so."
        )
    vertices = document.numbers(attributes["POSITION"], 3).astype(np.float64)
    count = len(vertices)
    order = np.arange(count)
    if "indices" in primitive:
        order = document.numbers(primitive["indices"], 1)[:, 0].astype(np.int64)
    if order.size and order.max() >= count:
        raise ValueError(f"a face names vertex {order.max()}, but there are only 0 to {count - 1}")
    faces = _triangles(order, primitive.get("mode", TRIANGLES))
    factor, described = _material(document, primitive)
    colors = None if factor is None else np.tile(factor, (count, 1))
    if "COLOR_0" in attributes:
        width = WIDTHS[document.item("accessors", attributes["COLOR_0"])["type"]]
        own = _each(document.numbers(attributes["COLOR_0"], width, shares=True), count, "colour")[:, :3]
        colors = own if colors is None else own * colors
    part = Part(vertices, faces, colors)
    return part if described is None else _textured(document, part, attributes, described)


def _each(found: NDArray, count: int, what: str) -> NDArray:
    if len(found) != count:
        raise ValueError(f"{len(found)} entries of a {what} came for {count} vertices; wanted one each")
    return found


def _triangles(order: Int[np.ndarray, "corners"], mode: Any) -> Int[np.ndarray, "faces 3"]:
    """Return the triangles of a primitive of the given mode (section 3.7.2.1, equations of primitive types)."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    inner = np.arange(max(len(order) - 2, 0))
    if mode == STRIP:
        return order[np.stack([inner, inner + 1 + inner % 2, inner + 2 - inner % 2], 1)]
    if mode == FAN:
        return order[np.stack([inner + 1, inner + 2, np.zeros_like(inner)], 1)]
    raise ValueError(f"its mode is {quote(mode)}; wanted 4, 5 or 6: triangles")


def _material(
    document: Document, primitive: dict[str, Any]
) -> tuple[Float[np.ndarray, "3"] | None, dict[str, Any] | None]:
    """Return the factor of the base colour, None where there is none, and the description of its texture."""
    if "material" not in primitive:
        return None, None
    material = document.item("materials", primitive["material"])
    if material.get("alphaMode", "OPAQUE") != "OPAQUE":
        document.notes.append("its transparency is left out.")
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if glossy is not None:
        factor, texture = glossy.get("diffuseFactor"), glossy.get("diffuseTexture")
    else:
        described = material.get("pbrMetallicRoughness", {})
        factor, texture = described.get("baseColorFactor"), described.get("baseColorTexture")
    if factor is None:
        return None, texture
    found = numbers(factor).reshape(-1)[:3]
    return (None if found.tolist() == [1, 1, 1] else found), texture


def _textured(document: Document, part: Part, attributes: dict[str, Any], described: dict[str, Any]) -> Part:
    moved = described.get("extensions", {}).get("KHR_texture_transform", {})
    name = f"TEXCOORD_{whole(moved.get('texCoord', described.get('texCoord', 0)))}"
    if name not in attributes:
        document.notes.append("a part with a texture says no places in it, and is drawn without.")
        return part
    uv = _each(document.numbers(attributes[name], 2), len(part.vertices), "place in a texture").astype(
        np.float64
    )
    if moved:
        # KHR_texture_transform: translation · rotation · scale, counter-clockwise where v runs downwards, as its text
        # and its test model say; the GLSL beside them turns the other way (github.com/KhronosGroup/glTF/issues/1563)
        angle = float(numbers(moved.get("rotation", 0)))
        turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        uv = (uv * numbers(moved.get("scale", (1, 1)))) @ turned.T
        uv = uv + numbers(moved.get("offset", (0, 0)))
    texture = document.item("textures", described["index"])
    image = _image(document, texture)
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


def _image(document: Document, texture: dict[str, Any]):
    number = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source", texture.get("source"))
    if number is None:
        document.notes.append("a texture is stored by an extension that is not understood: drawn without.")
        return None
    image = document.item("images", number)
    known = document.pictures.known(number)
    if known is not None:
        return known
    uri = image.get("uri")
    if uri is not None and not uri.startswith("data:"):
        file = drawn_without(
            document.folder, unquote(uri, errors="surrogateescape"), "texture is", document.notes
        )
        if file is None:
            return None
        content, name = document.of_file(file), shorten(uri, 60)
    elif uri is not None:
        content, name = document.referred(uri), shorten(uri, 60)
    else:
        content, name = bytes(document.view(image["bufferView"])[0]), f"{number}"
    return document.pictures.decode(number, content, name)
