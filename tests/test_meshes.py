"""Tests of mesh and cloud files, undamaged and damaged, and of points sampled from surfaces."""

import io
import os
import struct
from itertools import product
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from framework.errors import DataError
from framework.geometry.meshes import Mesh, normals, read, sample, stream

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
HEAD = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = b"element face 1\nproperty list uchar int vertex_indices\n"
END = b"end_header\n"
POINTS = b"0 0 0\n1 0 0\n0 1 0\n"
FACET = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"


def archive(**arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def array(values):
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def binary_stl(faces):
    records = b"".join(struct.pack("<12fH", 0, 0, 1, *np.ravel(face), 7) for face in faces)
    return b"solid as many exporters begin".ljust(80) + struct.pack("<I", len(faces)) + records


def binary_ply(order, faces=((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)), extra=b""):
    name = {"<": b"little", ">": b"big"}[order]
    header = b"ply\nformat binary_%s_endian 1.0\ncomment made\nelement vertex 4\n" % name
    header += (
        b"property double z\nproperty uchar red\nproperty double y\nproperty float x\nproperty short level\n"
    )
    header += b"element edge 2\nproperty int a\nproperty list uchar float b\n"
    header += b"element face %d\nproperty uchar flags\nproperty list uint ushort vertex_index\nend_header\n"
    body = b"".join(
        struct.pack(f"{order}dBdfh", z, 51 * i, y, x, -i) for i, (x, y, z) in enumerate(TETRAHEDRON)
    )
    body += struct.pack(f"{order}iB2f", 1, 2, 0.5, 0.5) + struct.pack(f"{order}iB", 1, 0)
    for face in faces:
        body += struct.pack(f"{order}BI{len(face)}H", 9, len(face), *face)
    return header % len(faces) + body + extra


def text_off(eol="\n", header="OFF\n4 4 6\n", face="3 {} {} {}", tail=""):
    lines = [" ".join(map(str, vertex)) for vertex in TETRAHEDRON] + [
        face.format(*corners) for corners in FACES
    ]
    return (header + "\n".join(lines) + "\n" + tail).replace("\n", eol).encode()


def at(folder, suffix, content):
    file = folder / f"thing{suffix}"
    file.write_bytes(content)
    return file


# ---- files that are read --------------------------------------------------------------------------------

STL = binary_stl(TETRAHEDRON[FACES])
TETRAHEDRA = {
    "off": (".off", text_off()),
    "off of the release: counts behind the word": (".off", text_off(header="OFF4 4 0\n")),
    "off: one line with a blank": (".off", text_off(header="OFF 4 4\n")),
    "off: comments, blank lines": (".off", text_off(header="\n# a\nOFF # b\n\n#c\n 4 4 6 # d\n\n", tail="\n\n")),
    "off: Windows": (".OFF", text_off(eol="\r\n")),
    "off: old Macintosh": (".off", text_off(eol="\r")),
    "off: colours of faces": (".off", text_off(face="3 {} {} {} 0.5 0.5 0.1 1")),
    "off: more than promised": (".off", text_off(tail="3 0 1 2\nend of file\n")),
    "obj": (".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 1\nvn 0 0 1\n"
            b"f 1 3 2\no other\nf 1/1/1 2//1 4/1\nf -4 -1 \\\n -2\ns off\nf\t2 3 4\n"),
    "stl": (".stl", binary_stl(TETRAHEDRON[FACES])),
    "ply, little": (".ply", binary_ply("<")),
    "ply, big": (".ply", binary_ply(">")),
    "ply, text": (".ply", b"ply\r\nformat ascii 1.0\r\nobj_info x\r\nelement vertex 4\r\nproperty float64 x\r\n"
                  b"property float64 y\r\nproperty float64 z\r\nelement face 4\r\n"
                  b"property list uchar int vertex_indices\r\nproperty float quality\r\nend_header\r\n"
                  b"0 0 0\r\n1 0 0\r\n0 1 0\r\n0 0 1\r\n3 0 2 1 .5\r\n3 0 1 3 .5\r\n3 0 3 2 .5\r\n3 1 2 3 .5\r\n"),
    "npz": (".npz", archive(points=TETRAHEDRON, faces=FACES)),
}  # fmt: skip


@pytest.mark.parametrize("suffix, content", TETRAHEDRA.values(), ids=TETRAHEDRA)
def test_a_tetrahedron_is_read_from_every_format(tmp_path, suffix, content):
    mesh = read(at(tmp_path, suffix, content))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], TETRAHEDRON[FACES])
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int64


@pytest.mark.parametrize(
    "suffix, content",
    [
        (".off", b"OFF\n5 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n.5 2 0\n4 0 1 2 3\n3 3 2 4\n"),
        (".obj", b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv .5 2 0\nf 1 2 3 4\nf 4 3 5\n"),
    ],
)
def test_polygons_are_cut_into_fans(tmp_path, suffix, content):
    assert read(at(tmp_path, suffix, content)).faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]]


@pytest.mark.parametrize("order", "<>")
def test_binary_polygons_of_different_sizes_are_cut_into_fans(tmp_path, order):
    mesh = read(at(tmp_path, ".ply", binary_ply(order, ((0, 1, 2, 3), (3, 2, 1)))))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 1]]


def test_text_stl_of_several_solids(tmp_path):
    content = b"solid a b\n" + FACET + b"endsolid a b\nSOLID\n".lower() + FACET + FACET + b"endsolid\n"
    mesh = read(at(tmp_path, ".STL", content))
    assert mesh.faces.shape == (3, 3)
    np.testing.assert_array_equal(mesh.vertices[3:6], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def spelled_stl(case, gap, name, eol):
    """The tetrahedron as text, with keywords in a case, "end" apart from what is ended, and a name of the solid."""
    lines = [f"solid{name}"]
    for corners in TETRAHEDRON[FACES]:
        lines += ["facet normal 0 0 0", "outer loop", *(f"vertex {a} {b} {c}" for a, b, c in corners)]
        lines += [f"end{gap}loop", f"end{gap}facet"]
    return eol.join([*map(case, lines), case(f"end{gap}solid{name}"), ""]).encode()


@pytest.mark.parametrize("case", [str.lower, str.upper, str.title], ids=lambda case: case.__name__)
@pytest.mark.parametrize("gap", ["", " ", "\t"])
def test_text_stl_is_read_however_its_keywords_are_written(tmp_path, case, gap):
    for name, eol in product(("", " me", " end facet", " vertex 1 2"), ("\n", "\r\n", "\n\n  ")):
        content = spelled_stl(case, gap, name, eol)
        mesh = read(at(tmp_path, ".stl", content))
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], TETRAHEDRON[FACES])
        for damaged in (
            content.rstrip().rsplit(b"\n", 1)[0],
            content.replace(case("vertex 0").encode(), b"vortex 0", 1),
        ):
            with pytest.raises(DataError, match="as many ends as beginnings"):
                read(at(tmp_path, ".stl", damaged))


@pytest.mark.parametrize("blank", [b"\n", b"\r\n", b" \n", b"\x1a"])
@pytest.mark.parametrize(
    "suffix, content", [(".stl", STL), (".ply", binary_ply("<")), (".ply", binary_ply(">"))]
)
def test_a_line_may_end_behind_a_binary_file(tmp_path, suffix, content, blank):
    mesh = read(at(tmp_path, suffix, content + blank))
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], TETRAHEDRON[FACES])
    for more in (b"\0", b"x", 9 * blank):
        with pytest.raises(DataError, match="bytes follow"):
            read(at(tmp_path, suffix, content + more))


CLOUDS = {
    "xyz": (".xyz", b"0 0 0\n1e0 -2.5 3\n", ()),
    "xyz: commas, Windows": (".xyz", b"0,0,0\r\n1,-2.5,3\r\n", ()),
    "xyz: names": (".xyz", b"x y z r nx Height\n0 0 0 1 1 5\n1 -2.5 3 0 0 6\n", ("red", "normal_x", "height")),
    "xyz: names in a comment": (".xyz", b"//X Y Z B\n0 0 0 1\n1 -2.5 3 0\n", ("blue",)),
    "xyz: no names": (".xyz", b"# made by hand\n\n0;0;0;7;8\n1;-2.5;3;9;10\n", ("column_4", "column_5")),
    "ply": (".ply", b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float nx\nproperty float x\nproperty float y\n"
            b"property float z\nproperty uchar green\nelement face 0\nproperty list uchar int vertex_indices\n"
            b"end_header\n1 0 0 0 0\n0 1 -2.5 3 255\n", ("normal_x", "green")),
    "npy": (".npy", array(np.array([[0, 0, 0, 4], [1, -2.5, 3, 4]], np.float32)), ("column_4",)),
    "npz": (".npz", archive(points=np.array([[0, 0, 0], [1, -2.5, 3]]), normals=np.eye(3)[:2], weight=np.ones(2),
            colors=np.full((2, 3), 255, np.uint8), colours=np.ones(2), camera=np.ones((3, 4))),
            ("normal_x", "normal_y", "normal_z", "weight", "red", "green", "blue")),
    "npz: one array": (".npz", archive(cloud=np.array([[0, 0, 0], [1, -2.5, 3]])), ()),
    "obj": (".obj", b"v 0 0 0 1 .5 0\nv 1 -2.5 3 0 0 1\n", ("red", "green", "blue")),
}  # fmt: skip


@pytest.mark.parametrize("suffix, content, columns", CLOUDS.values(), ids=CLOUDS)
def test_clouds_are_read_with_their_columns(tmp_path, suffix, content, columns):
    cloud = read(at(tmp_path, suffix, content))
    np.testing.assert_array_equal(cloud.vertices, [[0, 0, 0], [1, -2.5, 3]])
    assert cloud.faces.shape == (0, 3)
    assert cloud.columns == columns
    assert cloud.attribute(columns).shape == (2, len(columns))


def laser_scan(points, number=3, version="1.2"):
    """Return a LAS file with map coordinates in millimetres, classes, colours and an attribute of two numbers."""
    header = laspy.LasHeader(point_format=number, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.array([4e5, 5e6, 0.0])
    header.add_extra_dim(laspy.ExtraBytesParams("Pair", "2f8"))
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = points.T
    scan.classification = np.arange(len(points)) % 5
    scan.intensity = np.arange(len(points))
    scan["Pair"] = points[:, :2] / 3
    if "red" in header.point_format.dimension_names:
        scan.red, scan.green, scan.blue = np.full((3, len(points)), [[0], [32768], [65535]])
    stream = io.BytesIO()
    scan.write(stream)
    return stream.getvalue()


@pytest.mark.parametrize(("version", "number"), [("1.2", 0), ("1.2", 3), ("1.3", 4), ("1.4", 6), ("1.4", 7)])
def test_a_laser_scan_is_read_with_all_numbers_of_its_points(tmp_path, version, number):
    points = np.random.default_rng(0).integers(0, 99_999, (50, 3)) / 1000 + [4e5, 5e6, 0.0]
    file = tmp_path / "scan.LAS"
    file.write_bytes(laser_scan(points, number, version))
    mesh = read(file)
    np.testing.assert_allclose(mesh.vertices, points, rtol=0, atol=1e-9)
    assert not len(mesh.faces)
    np.testing.assert_array_equal(mesh.attribute(("classification",))[:, 0], np.arange(50) % 5)
    np.testing.assert_array_equal(mesh.attribute(("intensity",))[:, 0], np.arange(50))
    np.testing.assert_array_equal(mesh.attribute(("pair_1", "pair_2")), points[:, :2] / 3)
    if "red" in mesh.columns:
        colours = mesh.attribute(("red", "green", "blue"))
        np.testing.assert_array_equal(colours, np.full((50, 3), [0, 32768 / 65535, 1]))


def test_a_laser_scan_that_is_compressed_or_cut_short_is_refused(tmp_path):
    content = laser_scan(np.full((20, 3), [4e5, 5e6, 1.0]))
    for name, damaged, message in (
        (
            "compressed",
            content[:104] + bytes([128 + 3]) + content[105:],
            r"compressed \(LAZ\); save the scan as LAS",
        ),
        ("cut", content[:-1], "its 20 points end at byte"),
        ("records", content[:100] + b"\xff" * 4 + content[104:], "records do not fit between the header"),
        ("other", b"text", "begins with LASF"),
    ):
        file = tmp_path / f"{name}.las"
        file.write_bytes(damaged)
        with pytest.raises(DataError, match=rf"{name}\.las.*{message}"):
            read(file)


def test_whole_number_colours_become_shares(tmp_path):
    mesh = read(at(tmp_path, ".ply", binary_ply("<")))
    assert mesh.columns == ("red", "level")
    np.testing.assert_allclose(mesh.attribute(["level", "red"]), [[0, 0], [-1, 0.2], [-2, 0.4], [-3, 0.6]])


def test_an_attribute_that_is_missing_not_finite_or_out_of_range_is_refused_when_asked_for(tmp_path):
    text = b"v 0 0 0 1 1 1\nv 1 0 0 nan 0 255\nv 0 1 0 0 0 0\nf 1 2 3\n"
    mesh = read(at(tmp_path, ".obj", text))
    np.testing.assert_array_equal(mesh.attribute(["green"]), [[1], [0], [0]])
    with pytest.raises(DataError, match=r"point 1 \(from 0\) has red = nan"):
        mesh.attribute(["green", "red"])
    with pytest.raises(DataError, match="colours go from 0 to 255; expected 0 to 1"):
        mesh.attribute(["blue"])
    with pytest.raises(DataError, match=r"no column 'gren'\. Did you mean 'green'"):
        mesh.attribute(["gren"])


def test_points_that_are_not_finite_are_named_or_dropped(tmp_path):
    text = b"v 0 0 0 1 1 1\nv 1 inf 0 0 0 0\nv 0 1 0 .5 0 0\nv 0 0 1 0 0 0\nf 1 2 3\nf 1 3 4\n"
    file = at(tmp_path, ".obj", text)
    with pytest.raises(DataError, match=r"1 of 4 points .* first is point 1 \(from 0\): \[1\.0, inf, 0\.0\]"):
        read(file)
    mesh = read(file, drop_non_finite=True)
    assert mesh.dropped == 1
    assert mesh.faces.tolist() == [[0, 1, 2]]
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(mesh.attribute(["red"])[:, 0], [1, 0.5, 0])
    with pytest.raises(DataError, match="2 of 2 points"):
        read(at(tmp_path, ".xyz", b"nan 0 0\n0 0 inf\n"), drop_non_finite=True)


ODD = [
    chr(code) for code in (0x0B, 0x0C, 0x1C, 0x1D, 0x1E, 0x1F, 0x85, 0xA0, 0xC5, 0xE0, 0x2028, 0x2029, 0x3000)
]
"""Characters that Python reads as line ends or blanks, and letters whose UTF-8 contains such bytes: Å is C3 85, à is
C3 A0."""


def written(letter):
    """Return the bytes of a text in UTF-8, and in Latin-1 if Latin-1 has its characters."""
    return {letter.encode(), letter.encode("latin-1", "ignore") or letter.encode()}


@pytest.mark.parametrize("letter", ODD, ids=[f"U+{ord(letter):04X}" for letter in ODD])
@pytest.mark.parametrize("eol", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("statement", [b"comment", b"obj_info"])
@pytest.mark.parametrize("binary", [False, True])
def test_a_header_of_ply_ends_its_lines_as_ply_says(tmp_path, letter, eol, statement, binary):
    for odd in written(letter):
        said = statement + b" by " + odd + b" K" + odd + b"re" + odd + b"\n"
        content = HEAD.replace(b"element", said + b"element", 1) + said + FACE + END
        content = content.replace(b"\n", eol) + (POINTS + b"3 0 1 2\n").replace(b"\n", eol)
        if binary:
            points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
            faces = struct.pack("<B3i", 3, 0, 1, 2)
            content = content.split(b"0 0 0" + eol)[0].replace(b"ascii", b"binary_little_endian")
            content += points + faces
        mesh = read(at(tmp_path, ".ply", content))
        np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        assert mesh.faces.tolist() == [[0, 1, 2]]


def test_data_behind_a_header_may_begin_with_the_byte_of_a_line_end(tmp_path):
    for first, eol in ((b"\n", b"\r"), (b"\r", b"\r\n"), (b"\n", b"\n"), (b"\n", b"\r\n")):
        lines = [b"ply", b"format binary_little_endian 1.0", b"element vertex 1", b"property uchar level"]
        lines += [b"property float " + axis for axis in (b"x", b"y", b"z")] + [b"end_header", b""]
        content = eol.join(lines) + first + np.array([1, 2, 3], "<f4").tobytes()
        mesh = read(at(tmp_path, ".ply", content))
        assert mesh.attribute(["level"]).tolist() == [[first[0]]]
        assert mesh.vertices.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("letter", ODD, ids=[f"U+{ord(letter):04X}" for letter in ODD])
@pytest.mark.parametrize("eol", [b"\n", b"\r\n", b"\r"])
def test_names_of_columns_may_hold_any_letter(tmp_path, letter, eol):
    if letter in "\x0b\x0c":
        return  # blanks in ASCII, too
    name = f"k{letter}re"
    table = f"x y z {name} weight\n1 2 3 4 5\n".encode()
    header = (
        HEAD.replace(b"vertex 3", b"vertex 1") + f"property float {name}\nproperty float weight\n".encode()
    )
    for suffix, content in (
        (".xyz", table),
        (".xyz", b"# " + table),
        (".ply", header + END + b"1 2 3 4 5\n"),
    ):
        mesh = read(at(tmp_path, suffix, content.replace(b"\n", eol)))
        assert mesh.columns == (name.lower(), "weight")
        assert mesh.attribute([name.lower(), "weight"]).tolist() == [[4, 5]]


# ---- files that are refused ------------------------------------------------------------------------------

STRIPS = b"element tristrips 1\nproperty list int int vertex_indices\n"
PLANE = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n" + END + b"0 0\n"
OTHER = b"ply\nformat ascii 1.0\nelement point 0\n" + END

BROKEN = {
    "off: empty": (".off", b"", "the file is empty"),
    "off: another word": (".off", b"COFF\n1 0 0\n0 0 0 1 1 1 1\n", "expected OFF in the first line, got 'COFF'"),
    "off: binary": (".off", b"OFF BINARY\n\0\0\0", "expected a whole number, got 'BINARY'"),
    "off: no counts": (".off", b"OFF\n", "got nothing"),
    "off: negative": (".off", b"OFF\n-1 2 0\n", "expected the numbers of vertices"),
    "off: cut short": (".off", text_off()[:-10], "only 7 lines follow; the file is cut short"),
    "off: cut within a line": (".off", text_off()[:-3], "expected 3 corners, got the line '3 1 2'"),
    "off: a word": (".off", b"OFF\n1 0 0\n0 zero 0\n", "expected a number, got 'zero'"),
    "off: two numbers": (".off", b"OFF\n2 0 0\n0 0\n0 0 0 0\n",
        "expected 3 numbers for each vertex, got the line '0 0'"),
    "off: no such vertex": (".off", text_off().replace(b"3 1 2 3", b"3 1 2 4"), r"triangle 3 .* \[1, 2, 4\]"),
    "off: half a vertex": (".off", text_off().replace(b"3 1 2 3", b"3 1 2 .5"), "expected a whole number, got '.5'"),
    "off: two corners": (".off", text_off().replace(b"3 1 2 3", b"2 1 2"), "face 3 .* has 2 corners"),
    "off: not one point": (".off", b"OFF\n0 0 0\n", "the file has no vertices"),
    "obj: empty": (".obj", b"# nothing\n", "the file has no vertices"),
    "obj: two corners": (".obj", b"v 0 0 0\nv 1 0 0\nf 1// 2//\n", "at least 3 corners, got the line f '1// 2//'"),
    "obj: vertex 0": (".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "names vertex 0"),
    "obj: before the first": (".obj", b"v 0 0 0\nv 1 0 0\nf -1 -2 -3\n", r"corners \[1, 0, -1\]"),
    "obj: some coloured": (".obj", b"v 0 0 0 1 1 1\nv 1 0 0\n", "expected 6 numbers for each vertex"),
    "obj: a plane": (".obj", b"v 0 0\nv 1 0\n", "expected 3 coordinates"),
    "stl: cut short": (".stl", STL[:-1], "has 283 bytes and announces 4 faces, which take 284"),
    "stl: too long": (".stl", STL + b"\0", "has 285 bytes"),
    "stl: empty": (".stl", b"", "announces 0 faces"),
    "stl: text cut short": (".stl", b"solid a\n" + FACET + FACET[:60], "2 facets with 5 corners, 1 ends of facets"),
    "stl: no end": (".stl", b"solid a\n" + FACET, "1 solids and 0 ends of solids"),
    "stl: a word": (".stl", b"solid a\n" + FACET.replace(b"1 0 0", b"1 o 0") + b"endsolid", "got 'o'"),
    "ply: no header": (".ply", b"ply\nformat ascii 1.0\n", "lacks .* the line `end_header`"),
    "ply: no format": (".ply", b"ply\nelement vertex 0\n" + END, "lacks a line that begins with `format`"),
    "ply: another format": (".ply", b"ply\nformat binary 1.0\n" + END,
        "expected a line of a PLY header .*, got 'format binary 1.0'"),
    "ply: no vertices": (".ply", OTHER, "lists the elements point; expected an element named `vertex`"),
    "ply: no z": (".ply", PLANE, "no properties z, only x, y"),
    "ply: cut short": (".ply", HEAD + END + POINTS[:-6], "announces 3 lines of data, but 2 lines follow"),
    "ply: too long": (".ply", HEAD + END + POINTS + POINTS, "but 6 lines follow"),
    "ply: a negative vertex": (".ply", HEAD + FACE + END + POINTS + b"3 0 1 -1\n", r"corners \[0, 1, -1\]"),
    "ply: two corners": (".ply", HEAD + FACE + END + POINTS + b"2 0 1\n", "face 0 .* has 2 corners"),
    "ply: strips": (".ply", HEAD + STRIPS + END + POINTS + b"0\n", "strips of triangles"),
    "ply: nothing in it": (".ply", HEAD.replace(b"3", b"0", 1) + END, "the file has no vertices"),
    "ply: binary cut short": (".ply", binary_ply("<")[:-1], "the file is cut short"),
    "ply: binary too long": (".ply", binary_ply(">", extra=b"\0\0"),
        "2 bytes follow after the data that the header announces"),
    "xyz: two numbers": (".xyz", b"0 0\n1 1\n", "at least 3 numbers for each point, got the line '0 0'"),
    "xyz: uneven": (".xyz", b"0 0 0\n1 1 1 1\n1 1\n", "expected 3 numbers for each point, got the line '1 1 1 1'"),
    "xyz: a name too few": (".xyz", b"x y z\n0 0 0 1\n", "names 3 columns, but each point has 4 numbers"),
    "xyz: empty": (".xyz", b"\n\n", "the file has no vertices"),
    "npy: a plane": (".npy", array(np.zeros((4, 2))), r"got float64 \(4, 2\)"),
    "npy: words": (".npy", array(np.array([["a", "b", "c"]])), "expected numbers of shape"),
    "npy: objects": (".npy", array(np.array([[{}, 1, 2]], dtype=object)), "cannot be read as NPY"),
    "npy: cut short": (".npy", array(np.zeros((4, 3)))[:-1], "cannot be read as NPY"),
    "npz: no points": (".npz", archive(a=np.zeros((4, 3)), b=np.zeros(3)), "an array named points, got a, b"),
    "npz: nothing in it": (".npz", archive(points=np.zeros((0, 3)), weight=np.zeros(0)), "the file has no vertices"),
    "npz: an array": (".npz", array(np.zeros((4, 3))), "a single array"),
    "npz: cut short": (".npz", archive(points=np.zeros((4, 3)))[:-30], "cannot be read as NPZ"),
    "npz: quads": (".npz", archive(points=np.zeros((4, 3)), faces=np.zeros((2, 4), int)), r"got int64 \(2, 4\)"),
    "another format": (".glb", b"glTF", r"expected a file whose name ends in \.off"),
}  # fmt: skip


@pytest.mark.parametrize("suffix, content, message", BROKEN.values(), ids=BROKEN)
def test_a_broken_file_is_refused_by_name(tmp_path, suffix, content, message):
    file = at(tmp_path, suffix, content)
    with pytest.raises(DataError, match=message) as raised:
        read(file)
    assert str(file) in str(raised.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read(tmp_path / "chair.off")


WHOLE = [*TETRAHEDRA.values(), *(cloud[:2] for cloud in CLOUDS.values())]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(WHOLE), st.data())
def test_damage_gives_a_mesh_or_a_sentence(tmp_path, whole, data):
    suffix, content = whole
    damaged = bytearray(content)
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.integers(0, len(damaged)))
        end = data.draw(st.integers(place, min(place + 8, len(damaged))))
        damaged[place:end] = data.draw(
            st.binary(max_size=8) | st.sampled_from([b"-1", b" 9e999 ", b"\n", b"4294967295"])
        )
    try:
        mesh = read(at(tmp_path, suffix, bytes(damaged)))
    except DataError as error:
        assert "thing" in str(error)
    else:
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.size == 0 or 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices)


REAL = {
    "busted.STL": (11634, 3878),
    "chair_model.obj": (3186, 12756),
    "comments.off": (8, 12),
    "empty.obj": "no vertices",
    "empty.ply": "no vertices",
    "multibody.stl": (96, 32),
    "nancolor.obj": (8, 12),
    "negative_indices.obj": (8, 12),
    "notenoughindices.obj": "at least 3 corners",
    "points_ascii.ply": (5, 0),
    "points_emptyface.ply": (1024, 0),
    "polygonfaces.obj": (5, 3),
    "soup.stl": (300, 100),
    "unit_cube.STL": (36, 12),
    "wallhole.obj": (92, 66),
    "whitespace.off": (8, 12),
}


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_every_real_file_loads_or_gives_a_sentence():
    folder = Path(os.environ["REAL_DATA_ROOT"]) / "meshes"
    assert {file.name for file in folder.iterdir()} == set(REAL)
    for name, wanted in REAL.items():
        if isinstance(wanted, str):
            with pytest.raises(DataError, match=wanted):
                read(folder / name)
            continue
        mesh = read(folder / name)
        assert (len(mesh.vertices), len(mesh.faces)) == wanted, name
        if wanted[1]:
            points = sample(mesh, 50, stream(0, name)).points
            assert (points >= mesh.vertices.min(0) - 1e-9).all(), name
            assert (points <= mesh.vertices.max(0) + 1e-9).all(), name


# ---- points of surfaces ----------------------------------------------------------------------------------


def soup(random, count, spread=1.0):
    """Return triangles of very different areas, every third with area 0."""
    vertices = random.normal(size=(count, 3, 3)) * np.exp(spread * random.normal(size=(count, 1, 1)))
    vertices[::3] = vertices[::3].astype(
        np.float32
    )  # whose midpoints are exact: no rounding gives them an area
    vertices[::3, 2] = (vertices[::3, 0] + vertices[::3, 1]) / 2
    vertices[::6, 2] = vertices[::6, 1]
    return Mesh("soup", vertices.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def heron(mesh):
    """Return the areas from the lengths of the sides in higher precision, independently of the tested code."""
    corners = mesh.vertices[mesh.faces].astype(np.longdouble)
    a, b, c = (np.sqrt(((corners[:, i] - corners[:, i - 1]) ** 2).sum(1)) for i in range(3))
    s = (a + b + c) / 2
    return np.sqrt(np.maximum(s * (s - a) * (s - b) * (s - c), 0)).astype(float)


def torus(across=120, around=60, radius=1.0, tube=0.35):
    u, v = np.meshgrid(np.arange(across), np.arange(around), indexing="ij")
    a, b = 2 * np.pi * u / across, 2 * np.pi * v / around
    far = radius + tube * np.cos(b)
    vertices = np.stack([far * np.cos(a), far * np.sin(a), tube * np.sin(b)], -1).reshape(-1, 3)
    right, up = (u + 1) % across, (v + 1) % around
    here, east, north, both = (i * around + j for i, j in ((u, v), (right, v), (u, up), (right, up)))
    faces = np.stack([np.stack([here, east, both], -1), np.stack([here, both, north], -1)], -2)
    return Mesh("torus", vertices, faces.reshape(-1, 3))


def test_faces_are_drawn_by_their_area():
    mesh = soup(np.random.default_rng(1), 60)
    areas = heron(mesh)
    drawn = np.bincount(sample(mesh, 400_000, np.random.default_rng(2)).face, minlength=60)
    assert drawn[::3].sum() == 0
    kept = areas * 400_000 / areas.sum() > 10
    kept[::3] = False
    scaled = areas[kept] / areas[kept].sum() * drawn[kept].sum()
    assert kept.sum() > 25
    assert chisquare(drawn[kept], scaled).pvalue > 1e-3


def test_points_are_uniform_within_a_face():
    mesh = Mesh("triangle", np.array([[0, 0, 0], [3, 0, 1], [1, 2, -1.0]]), np.array([[0, 1, 2]]))
    weights = sample(mesh, 200_000, np.random.default_rng(3)).weights
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-15)
    # four triangles of the same area: at each corner and in the middle
    part = np.where(weights.max(1) > 0.5, weights.argmax(1), 3)
    assert chisquare(np.bincount(part)).pvalue > 1e-3
    # uniform on the simplex: Dirichlet(1, 1, 1), covariance (δ/3 - 1/9) / 4
    np.testing.assert_allclose(np.cov(weights.T), (np.eye(3) / 3 - 1 / 9) / 4, atol=4e-4)


def test_a_torus_has_the_moments_of_its_surface():
    found = sample(torus(), 300_000, np.random.default_rng(4)).points
    np.testing.assert_allclose(found.mean(0), 0, atol=6e-3)
    # dA = r (R + r cos v) du dv, so E ρ² = R² + 3 r² / 2 and E z² = r² / 2
    squared = (found[:, :2] ** 2).sum(1)
    assert abs(squared.mean() / (1 + 1.5 * 0.35**2) - 1) < 5e-3
    assert abs((found[:, 2] ** 2).mean() / (0.5 * 0.35**2) - 1) < 1e-2


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 40), st.floats(0, 8), st.integers(1, 200))
def test_every_point_lies_in_its_face(seed, faces, spread, count):
    random = np.random.default_rng(seed)
    mesh = soup(random, faces + 1, spread)
    found = sample(mesh, count, random)
    assert (found.face % 3 != 0).all()
    corners = mesh.vertices[mesh.faces[found.face]]
    reach = np.abs(corners).max((1, 2))
    brute = np.array([w @ c for w, c in zip(found.weights, corners, strict=True)])
    assert (np.abs(found.points - brute).max(1) <= 1e-14 * reach).all()
    assert (found.weights >= 0).all()


@pytest.mark.parametrize("power", [-660, -300, -30, 30, 300, 660, 1000])
def test_any_scale_gives_the_same_points(power):
    mesh = soup(np.random.default_rng(5), 20)
    factor = 2.0**power
    scaled = Mesh("scaled", mesh.vertices * factor, mesh.faces)
    one, other = (sample(each, 100, np.random.default_rng(6)) for each in (mesh, scaled))
    np.testing.assert_array_equal(one.face, other.face)
    np.testing.assert_array_equal(one.points * factor, other.points)
    np.testing.assert_array_equal(normals(mesh), normals(scaled))


def test_normals_point_outwards_and_are_zero_without_an_area():
    found = normals(Mesh("tetrahedron", TETRAHEDRON, np.concatenate([FACES, [[0, 0, 1]]])))
    np.testing.assert_allclose(
        found, [[0, 0, -1], [0, -1, 0], [-1, 0, 0], np.ones(3) / np.sqrt(3), [0, 0, 0]]
    )
    surface = torus()
    middle = surface.vertices[surface.faces].mean(1)
    ring = middle * [1, 1, 0] / np.linalg.norm(middle[:, :2], axis=1, keepdims=True)
    assert ((normals(surface) * (middle - ring)).sum(1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals(surface), axis=1), 1, atol=1e-15)


def test_the_same_seed_and_name_give_the_same_points():
    mesh = torus(12, 6)
    points = [sample(mesh, 20, stream(*key)).points for key in ((0, "a"), (0, "a"), (1, "a"), (0, "b"))]
    np.testing.assert_array_equal(points[0], points[1])
    assert not np.array_equal(points[0], points[2])
    assert not np.array_equal(points[0], points[3])


@pytest.mark.parametrize(
    "mesh, message",
    [
        (Mesh("cloud", TETRAHEDRON, np.empty((0, 3), int)), "cloud: the mesh has no faces"),
        (Mesh("point", np.zeros((3, 3)), np.array([[0, 1, 2]])), "point: the 1 faces have no area"),
        (
            Mesh("line", np.eye(3)[:1] * np.arange(4)[:, None], np.array([[0, 1, 2], [1, 2, 3]])),
            "2 faces have no area",
        ),
    ],
)
def test_a_surface_without_an_area_is_refused(mesh, message):
    with pytest.raises(DataError, match=message):
        sample(mesh, 10, np.random.default_rng(0))


def test_sides_beyond_all_numbers_are_refused():
    huge = Mesh("huge", TETRAHEDRON * 1e308 - 9e307, FACES)
    assert np.isfinite(sample(huge, 10, np.random.default_rng(0)).points).all()
    with pytest.raises(DataError, match="too long for float64"):
        sample(Mesh("infinite", (TETRAHEDRON * 2 - 1) * 1.7e308, FACES), 10, np.random.default_rng(0))
