"""Numbers, headers and encodings as people and programs write them, through every reader of text.

A case is read with the right value, or refused with a sentence that names file and line and says what to do; no reader
makes other numbers of it silently.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.geometry import meshes
from plugins.data.bodies import motion
from plugins.data.head_pose import towncentre_labels
from plugins.renderer.rasterizer import scene_files


@dataclass(frozen=True)
class TextReader:
    """A reader of text, and a file for it.

    Attributes:
        name: of the file.
        content: with {} where the number in question stands.
        read: the number in question.
        line: where it stands, from 1; 0 where no line is named.
        beside: other files that the reader wants.
        signed: whether the number may be negative.
    """

    name: str
    content: str
    read: Callable[[Path], float]
    line: int
    beside: dict[str, str | bytes] | None = None
    signed: bool = True


def vertex(file: Path) -> float:
    return float(meshes.read(file).vertices[2, 1])


def color(file: Path) -> float:
    return float(meshes.read(file).attribute(("green",))[2, 0])


def material(file: Path) -> float:
    colors = scene_files.read(file.with_suffix(".obj")).scene.colors
    return float(colors[0, 1])  # type: ignore[index]


OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 {} 0\n3 0 1 2\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 {} 0\n3 0 1 2\n"
)
OBJ = "# a triangle\nv 0 0 0\nv 1 0 0\nv 0 {} 0\nf 1 2 3\n"
COLOURED = "v 0 0 0 0 0 0\nv 1 0 0 0 0 0\nv 0 1 0 1 {} 0\nf 1 2 3\n"
STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 {} 0\nendloop\nendfacet\n"
    "endsolid a\n"
)
MTL = "newmtl a\nKd 1 {} 0\n"
NAMED = "mtllib one.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"
BVH = (
    "HIERARCHY\nROOT Hips\n{{\nOFFSET 0 {} 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n"
    "End Site\n{{\nOFFSET 0 1 0\n}}\n}}\nMOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0\n"
)
TURNED = BVH.replace("OFFSET 0 {} 0", "OFFSET 0 0 0").replace("\n0 0 0\n", "\n0 0 {}\n")


def turned(file: Path) -> float:
    rotation = motion.read(file).rotations[0, 0]
    return math.degrees(math.atan2(rotation[1, 0], rotation[0, 0]))


READERS = {
    "OFF": TextReader("one.off", OFF, vertex, 5),
    "PLY": TextReader("one.ply", PLY, vertex, 12),
    "OBJ": TextReader("one.obj", OBJ, vertex, 4),
    "OBJ, colours": TextReader("one.obj", COLOURED, color, 3, signed=False),
    "STL": TextReader("one.stl", STL, vertex, 6),
    "MTL": TextReader("one.mtl", MTL, material, 2, {"one.obj": NAMED}, signed=False),
    "XYZ": TextReader("one.xyz", "0 0 0\n1 0 0\n0 {} 0\n", vertex, 3),
    "XYZ, semicolons": TextReader("one.xyz", "x;y;z\n0;0;0\n1;0;0\n0;{};0\n", vertex, 4),
    "XYZ, tabs": TextReader("one.xyz", "# x y z\n0\t0\t0\n1\t0\t0\n0\t{}\t0\n", vertex, 4),
    "BVH, offsets": TextReader("walk.bvh", BVH, lambda file: float(motion.read(file).offsets[0, 1]), 4),
    "BVH, frames": TextReader("walk.bvh", TURNED, turned, 14),
    "labels of TownCentre": TextReader(
        "one.txt", "pan = {}\nvalid = 1\n", lambda file: towncentre_labels.read_label(file)[0], 1
    ),
}
NOT_NUMBERS = (
    *(
        "1,5",
        "1,234",
        "1.234,5",
        "1'234",
        "5%",
        "$5",
        "5 €",
        "TRUE",
        "1_0",
        "0x10",
        "(5)",
        "5-",
        '"5"x',
        "<5",
        "1.5e",
    ),
    *(f"1{blank}234" for blank in "\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\N{THIN SPACE}"),
    *("NA", "1.5.2", "1#5", "0.5#c", "1/2", "abc", "-"),
    *("1.#IND", "-1.#IND00", "1.#INF", "-1.#INF", "1.#QNAN", "1.#J", "nan", "-inf", "1e999"),
)
"""What is refused by every reader, or says that there is no number."""
NUMBERS = {
    "0.5": 0.5, "+.5": 0.5, "5e-1": 0.5, "5E-001": 0.5, "0.05D+1": 0.5, "5.d-01": 0.5, "5D-1": 0.5,
    "\N{MINUS SIGN}0.5": -0.5, "5e\N{MINUS SIGN}1": 0.5, "\N{EN DASH}0.5": -0.5,
}  # fmt: skip
"""What means one number alone: read by every reader, or refused."""


def write(folder: Path, reader: TextReader, word: str) -> Path:
    file = folder / reader.name
    file.parent.mkdir(exist_ok=True, parents=True)
    for name, content in (reader.beside or {}).items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    file.write_bytes(reader.content.format(word).encode())
    return file


@pytest.mark.parametrize("name", READERS)
def test_numbers_are_read_right_or_refused_by_line(tmp_path: Path, name: str) -> None:
    reader = READERS[name]
    for word, number in [*NUMBERS.items(), *((word, None) for word in NOT_NUMBERS)]:
        if number is not None and number < 0 and not reader.signed:
            continue
        file = write(tmp_path, reader, word)
        try:
            found = reader.read(file)
        except DataError as error:
            said = str(error)
            assert number is None, f"{name}, {word}: {said}"
            assert str(tmp_path) in said, f"{name}, {word}: {said}"
            assert f"line {reader.line}" in said.lower() or "finite" in said, f"{name}, {word}: {said}"
            assert any(remedy in said for remedy in ("write", "Write", "Mend", "Save", "Restore")), said
        else:
            assert number is not None, f"{name}: {word!r} is read as {found}"
            assert found == pytest.approx(number, rel=1e-6), f"{name}, {word}"


@pytest.mark.parametrize("name", READERS)
def test_encodings_and_ends_of_lines_change_no_number(tmp_path: Path, name: str) -> None:
    reader = READERS[name]
    file = write(tmp_path, reader, "0.5")
    whole = reader.read(file)
    assert whole == pytest.approx(0.5, rel=1e-6)
    plain = file.read_bytes()
    for changed in (
        b"\xef\xbb\xbf" + plain,
        plain.replace(b"\n", b"\r\n"),
        plain.replace(b"\n", b"\r"),
        b"\xef\xbb\xbf" + plain.replace(b"\n", b"\r\n"),
        plain.rstrip(b"\n"),
        plain + b"\n\n",
    ):
        file.write_bytes(changed)
        assert reader.read(file) == whole, changed[:60]
    for encoding in ("utf-16", "utf-16-le", "utf-16-be", "utf-32"):
        file.write_bytes(plain.decode().encode(encoding))
        with pytest.raises(DataError, match=r"UTF-(16|32).*wanted UTF-8. Save it as UTF-8") as raised:
            reader.read(file)
        assert str(tmp_path) in str(raised.value)
