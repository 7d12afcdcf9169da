"""Scene files for tests: functions that write glTF from a description and arrays, a glTF sample, an OBJ sample."""

import base64
import copy
import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
Entry = dict[str, Any]


def describe(content: Entry, parts: Sequence[NDArray | bytes]) -> tuple[Entry, bytes]:
    """Return the complete JSON description of a glTF file, and its binary part.

    The binary part holds `parts` in their order. An accessor and a buffer view are added to the description for each
    array, and only a buffer view for bytes.

    Args:
        content: description without accessors, buffer views and buffer.
        parts: arrays and bytes of the binary part.
    """
    content = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], **copy.deepcopy(content)}
    binary = b""
    for part in parts:
        data = part if isinstance(part, bytes) else part.tobytes()
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
        content["bufferViews"].append(view)
        if not isinstance(part, bytes):
            width = 1 if part.ndim == 1 else part.shape[1]
            kind = KINDS[part.dtype.str[1:]]
            accessor = {
                "bufferView": len(content["bufferViews"]) - 1,
                "componentType": kind,
                "count": len(part),
            }
            content["accessors"].append({**accessor, "type": TYPES[width]})
        binary += data + bytes(-len(data) % 4)
    content["buffers"] = [{"byteLength": len(binary)}]
    return content, binary


def glb(content: Entry, parts: Sequence[NDArray | bytes]) -> bytes:
    """Return the bytes of a .glb file; `content` is its description and `parts` its binary parts, as in `describe`."""
    description, binary = describe(content, parts)
    return pack_glb(json.dumps(description).encode(), binary)


def pack_glb(text: bytes, binary: bytes) -> bytes:
    """Return the bytes of a .glb file from its description as JSON and its binary part."""
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    words = [b"glTF", (2).to_bytes(4, "little"), size.to_bytes(4, "little")]
    words += [
        len(text).to_bytes(4, "little"),
        b"JSON",
        text,
        len(binary).to_bytes(4, "little"),
        b"BIN\0",
        binary,
    ]
    return b"".join(words)


def gltf(content: Entry, parts: Sequence[NDArray | bytes]) -> bytes:
    """Return the bytes of a .gltf file with the binary part in base64; `content` and `parts` are as in `describe`."""
    description, binary = describe(content, parts)
    description["buffers"][0]["uri"] = (
        "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    )
    return json.dumps(description).encode()


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")
ORDER = np.array([0, 1, 2, 0, 2, 3], "<u2")
COLORS = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [255, 255, 255, 255]], "u1")
JOINTS, WEIGHTS = np.zeros((4, 4), "u1"), np.tile(np.array([1, 0, 0, 0], "<f4"), (4, 1))
QUAD: Entry = {
    "scene": 0,
    "scenes": [{"nodes": [0, 2]}],
    "nodes": [
        {
            "mesh": 0,
            "rotation": [0, 0.6, 0, 0.8],
            "scale": [1, -2, 1],
            "translation": [0, 1, 0],
            "children": [1],
        },
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1]},
        {"mesh": 0, "skin": 0},
    ],
    "skins": [{"joints": [0], "inverseBindMatrices": 6}],
    "meshes": [
        {
            "primitives": [
                {
                    "attributes": {
                        "POSITION": 0,
                        "TEXCOORD_0": 1,
                        "COLOR_0": 3,
                        "JOINTS_0": 4,
                        "WEIGHTS_0": 5,
                    },
                    "indices": 2,
                    "material": 0,
                }
            ]
        }
    ],
    "materials": [
        {
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.5, 1, 1, 1],
                "baseColorTexture": {"index": 0, "texCoord": 0},
            }
        }
    ],
    "textures": [{"source": 0, "sampler": 0}],
    "samplers": [{"wrapS": 33071, "wrapT": 33071}],
    "images": [{"bufferView": 7, "mimeType": "image/png"}],
}
"""Description of a textured and coloured square that is shown by three nodes, one of them with a skin."""
PARTS: list[NDArray | bytes] = [
    CORNERS,
    UV,
    ORDER,
    COLORS,
    JOINTS,
    WEIGHTS,
    np.eye(4, dtype="<f4").reshape(1, 16),
]


def png(pixels: NDArray) -> bytes:
    """Return the bytes of a .png file."""
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, "PNG")
    return content.getvalue()


def quad() -> tuple[Entry, list[NDArray | bytes]]:
    """Return the glTF description of a textured square (`QUAD`), and the binary parts to which it refers."""
    return QUAD, [*PARTS, png(np.zeros((4, 4, 3), np.uint8))]


OBJ = b"""mtllib one.mtl
v 0 0 0 1 0 0
v 1 0 0 0 1 0
v 1 1 0 0 0 1
v 0 1 0 1 1 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl red
f 1/1 2/2 3/3
usemtl blue
f -4/-4/ -2/-2/ -1/-1/
"""
MTL = b"newmtl red\nKd 1 0 0\nmap_Kd -clamp on one.png\nnewmtl blue\nKd 0 0 1\nmap_Kd one.png\n"
