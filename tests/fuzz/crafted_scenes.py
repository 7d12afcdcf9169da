"""Malicious scenes: wrong sizes, circular references, and references to other files."""

import copy
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from framework.testing.sample_scenes import describe, glb, pack_glb, quad
from tests.fuzz.crafted_files import HUGE, plain_png
from tests.fuzz.damage import EXTREME, spoilt


def in_glb(content: bytes, random: np.random.Generator) -> bytes:
    """Damage a value of the description or bytes of the binary part, and make the lengths right."""
    size = int.from_bytes(content[12:16], "little")
    text, binary = content[20 : 20 + size], content[28 + size :]
    if random.random() < 0.3:
        return pack_glb(text, spoilt(binary, random))
    return pack_glb(in_gltf(text, random), binary)


def in_gltf(content: bytes, random: np.random.Generator) -> bytes:
    """Replace a value of the description by another or an extreme value, or remove it."""
    whole = json.loads(content)
    places = [*_places(whole)]
    holder, key = places[int(random.integers(len(places)))]
    other, of_other = places[int(random.integers(len(places)))]
    values = [*EXTREME, -1, 0.5, -1e308, "x", "", None, True, [], {}, copy.deepcopy(other[of_other])]
    holder[key] = values[int(random.integers(len(values)))]
    if random.random() < 0.1:
        del holder[key]
    return json.dumps(whole).encode()


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def crafted() -> Iterator[bytes]:
    """Yield small GLB files that state huge sizes, refer to other files, or contain circular references."""
    content, parts = quad()
    whole, binary = describe(content, parts)

    def changed(*path: str | int, value: Any) -> bytes:
        new = copy.deepcopy(whole)
        place: Any = new
        for step in path[:-1]:
            place = place[step]
        place[path[-1]] = value
        return pack_glb(json.dumps(new).encode(), binary)

    yield changed("accessors", 0, "count", value=HUGE)
    yield changed("accessors", 0, value={"componentType": 5126, "count": HUGE, "type": "VEC3"})
    yield changed("accessors", 0, "sparse", value={"count": HUGE, "indices": {}, "values": {}})
    yield changed("bufferViews", 0, "byteStride", value=1)
    yield changed("bufferViews", 0, "byteOffset", value=-4)
    yield changed("nodes", 1, "children", value=[0])
    yield changed("nodes", 1, "children", value=[1])
    yield changed("nodes", 0, "children", value=[-1])
    yield changed("nodes", 0, "translation", value=[1e308, 1e309, 0])
    yield changed("nodes", 0, "rotation", value=[1e200] * 4)
    yield changed("nodes", value=[{"mesh": 0}] * 10**5)
    yield changed("scenes", 0, "nodes", value=[0] * 10**5)
    yield glb({**content, "nodes": [{"mesh": 0}] * 10**5, "scenes": [{"nodes": [*range(10**5)]}]}, parts)
    yield changed("meshes", 0, "primitives", value=whole["meshes"][0]["primitives"] * 10**4)
    for address in (
        "/dev/zero",
        "../one.png",
        "file:///etc/passwd",
        "http://localhost/one.png",
        "data:,x",
        "\0",
    ):
        yield changed("images", 0, value={"uri": address})
        yield changed("buffers", 0, value={"uri": address, "byteLength": 4})
    for size in ((9_000, 9_000), (65_000, 65_000), (70_000, 2)):
        yield glb(content, [*parts[:-1], plain_png(*size, rows=1)])
    yield pack_glb(b"[" * 10**6, b"")
    yield pack_glb(b'{"asset": ' * 10**5, b"")
    yield b"glTF" + bytes(8)


MTLS = [
    b"newmtl red\nmap_Kd /etc/passwd\n",
    b"newmtl red\nmap_Kd ../../one.png\n",
    b"newmtl red\nmap_Kd -o 1 2 3 one.png\n",
    b"newmtl red\nKd nan 0 0\n",
    b"newmtl red\nKd " + b"1 " * 10**5,
]
