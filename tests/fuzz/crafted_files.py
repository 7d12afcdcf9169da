"""Malicious files, which try to take all memory, to hang, to read other files or to run code."""

import hashlib
import io
import json
import math
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import pyarrow as pa
import torch
from PIL import Image
from pyarrow import parquet

from framework.storage.checkpoints import MARK

BOMB = 2**27 + 2**20
"""Decompressed size of the compressed files, bytes; a thousand times their own size, and more than
`most_decompressed`."""
HUGE = 10**9


@cache
def zeros(header: bytes = b"") -> bytes:
    """Return a header and many zeros, compressed by zlib."""
    packer, block = zlib.compressobj(1), bytes(2**20)
    return (
        packer.compress(header) + b"".join(packer.compress(block) for _ in range(BOMB >> 20)) + packer.flush()
    )


def npy_header(shape: object, kind: str = "<f8", data: bytes = b"") -> bytes:
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + data


NPY = [
    npy_header((0, HUGE)), npy_header((HUGE, 0)), npy_header((10**15, 3)), npy_header((2**62, 2**62, 2**62)),
    npy_header((-1, -3), data=bytes(24)), npy_header((2, 10**5), "|u1", bytes(2 * 10**5)), npy_header((HUGE,), "|V0"),
    npy_header((HUGE, 3), "<U0"), npy_header("(" * 5000), npy_header("-" * 9000 + "1"), npy_header((1, 3), "|O"),
    npy_header("(1, 3), 'shape': __import__('os')"),
]  # fmt: skip


def zip_of(parts: dict[str, bytes], **how: Any) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", **how) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return packed.getvalue()


def deflated_part(name: str, packed: bytes, size: int, declared: int | None = None) -> bytes:
    """Return a zip archive of one part that is already compressed, with a chosen declared size."""
    raw = packed[2:-4]  # zlib's without its header and checksum
    fields = (20, 0, 8, 0, 0, 0, len(raw), size if declared is None else declared, len(name), 0)
    local = b"PK\x03\x04" + struct.pack("<5H3I2H", *fields) + name.encode() + raw
    entry = b"PK\x01\x02" + struct.pack("<6H3I5H2I", 20, *fields, 0, 0, 0, 0, 0) + name.encode()
    return local + entry + b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, 1, 1, len(entry), len(local), 0)


def npz(name: str) -> Iterator[bytes]:
    """Return archives in which the array of this name declares a wrong type or size."""
    array = npy_header((4, 3), data=bytes(96))
    packed, size = zeros(npy_header((BOMB // 24, 3))), BOMB + 128
    yield deflated_part(f"{name}.npy", packed, size)
    yield deflated_part(f"{name}.npy", packed, size, 1000)
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        yield zip_of({f"{name}.npy": array}, compression=method)
    whole = zip_of({f"{name}.npy": array})
    central = whole.index(b"PK\x01\x02")
    for at, flag in ((6, 1), (8, 99)):  # as if encrypted, and by a method that nobody knows
        made = bytearray(whole)
        made[at] = made[central + at + 2] = flag
        yield bytes(made)
    yield from (zip_of({f"{name}.npy": one}) for one in NPY)


def ply(lines: list[str], body: bytes = b"") -> bytes:
    head = ["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]
    return "\n".join(head).encode() + body


AXES = [f"property float {axis}" for axis in "xyz"]
PLY = [
    ply(["element vertex 0", *AXES, f"element thing {2**31}", "property uchar a"], b"\0" * 99),
    ply([f"element vertex {2**31}", *AXES], b"\0" * 99),
    ply([f"element vertex {2**31}"]),
    ply(
        ["element vertex 1", *AXES, f"element face {2**31}", "property list uchar int vertex_indices"],
        b"\0" * 999,
    ),
    ply(
        ["element vertex 1", *AXES, "element face 1", "property list uint int vertex_indices"],
        b"\0" * 12 + b"\xff" * 4,
    ),
    ply(["element vertex 1", *(f"property uchar p{number}" for number in range(50_000))]),
    ply([f"element e{number} 0" for number in range(50_000)]),
]
OFF = [
    b"OFF\n2147483648 2147483648 0\n",
    b"OFF 1 1 0\n0 0 0\n1000000000 0 0 0\n",
    b"OFF\n-1 -1 0\n",
    b"OFF\n1 0 0\n" + b"9" * 10**6,
]
XYZ = [b"1 " * 10**6, b"x y z " + b"c " * 10**6 + b"\n1 2 3", b"1e999 2 3\n", b"0x10 2 3\n", b"1_0 2 3"]
CSV = [
    b"," * 10**7,
    b"a" * 10**6 + b"\n1\n",
    b'a,b\n"' + b"x" * 10**6,
    b"a,b\n\0,1\n",
    b"file,pan\n" + b"../" * 10**5 + b",1\n",
    b"a;b\n1;2\n",
]


def parquets() -> list[bytes]:
    """Return Parquet tables of a few kilobytes with many equal numbers, long equal words, and many columns."""
    rows = BOMB // 8
    tables = [
        pa.table({"a": pa.DictionaryArray.from_arrays(pa.nulls(rows, pa.int32()), pa.array([0.0]))}),
        pa.table({"a": pa.DictionaryArray.from_arrays([0] * 10**5, pa.array(["x" * 10**6]))}),
        pa.table({"a": ["x" * BOMB]}),
        pa.table({str(number): pa.nulls(1) for number in range(20_000)}),
        pa.table({}),
        pa.table([[1], [2]], names=["a", "a"]),
    ]
    files = []
    for table in tables:
        stream = io.BytesIO()
        parquet.write_table(table, stream, compression="zstd", store_schema=False)
        files.append(stream.getvalue())
    return [*files, b"PAR1" * 3, b"PAR1\x15" + b"\xff" * 100 + b"PAR1"]


def las_files() -> list[bytes]:
    """Return headers of LAS files that announce too many points, records or bytes."""
    header = bytearray(375 + 30)
    header[:4], header[24:26] = b"LASF", bytes([1, 4])
    struct.pack_into(
        "<HIIBH", header, 94, 375, 375, 0, 6, 30
    )  # header, offset of points, records, format, size
    struct.pack_into("<3d", header, 131, 1, 1, 1)
    files = []
    for offset, kind, value in (
        (100, "<I", 2**32 - 1),  # records before the points
        (105, "<H", 0),  # bytes of a point
        (105, "<H", 2**16 - 1),
        (104, "<B", 128 + 6),  # compressed points
        (131, "<d", math.nan),  # scale
        (243, "<I", 2**32 - 1),  # records behind the points
        (247, "<Q", HUGE),  # points
        (247, "<Q", 2**64 - 1),
    ):
        changed = header.copy()
        struct.pack_into("<Q", changed, 247, 1)
        struct.pack_into(kind, changed, offset, value)
        files.append(bytes(changed))
    return files


def plain_png(width: int, height: int, rows: int | None = None) -> bytes:
    """Return a black PNG that contains only the first `rows` rows."""
    row = 1 + -(-width // 8)
    packer = zlib.compressobj(1)
    block = bytes(row * max(1, 2**20 // row))
    left, data = row * (height if rows is None else rows), b""
    while left > 0:
        data += packer.compress(block[: min(left, len(block))])
        left -= len(block)
    chunks = (
        (b"IHDR", struct.pack(">2I5B", width, height, 1, 0, 0, 0, 0)),
        (b"IDAT", data + packer.flush()),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(inner)) + kind + inner + struct.pack(">I", zlib.crc32(kind + inner))
        for kind, inner in chunks
    )


def images() -> Iterator[bytes]:
    yield plain_png(13_000, 13_000)
    yield plain_png(1, 10**7)
    yield plain_png(10**7, 1)
    yield plain_png(65_535, 30)
    yield plain_png(30, 65_535)
    yield plain_png(2**20, 2**31 - 1, rows=1)
    yield b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n(out) (w) file\nshowpage\n"
    packed = io.BytesIO()
    Image.new("RGB", (9, 9)).save(packed, "PNG")
    text = b"zTXt" + b"a\0\0" + zeros()
    yield (
        packed.getvalue()[:33]
        + struct.pack(">I", len(text) - 4)
        + text
        + struct.pack(">I", zlib.crc32(text))
        + packed.getvalue()[33:]
    )


def mat_element(kind: int, data: bytes) -> bytes:
    return struct.pack("<2I", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def mat_array(name: str, kind: int, sides: tuple[int, ...], *data: bytes) -> bytes:
    head = mat_element(6, struct.pack("<2I", kind, 0)) + mat_element(
        5, struct.pack(f"<{len(sides)}i", *sides)
    )
    return mat_element(14, head + mat_element(1, name.encode()) + b"".join(data))


def mat(name: str) -> Iterator[bytes]:
    """Return MATLAB 5 files in which the variable of this name declares a wrong type or size."""
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    fields = mat_element(5, struct.pack("<i", 4)) + mat_element(1, b"a\0\0\0")
    most = 2**31 - 1
    for kind, sides, data in (
        (6, (most, most), mat_element(9, bytes(8))), (1, (most, 2), mat_element(14, b"")), (2, (most, 1), fields),
        (2, (most, 1), mat_element(5, struct.pack("<i", 1)) + mat_element(1, b"")),
        (4, (most, 1), mat_element(4, b"ab")),
        (4, (10**6, 10**6), mat_element(16, b"ab")), (6, (-1, -1), mat_element(9, bytes(8))), (5, (9, 9), b""),
        (6, (0, most), mat_element(9, b"")), (1, (0, most), b""), (17, (1, 1), b""),
        (2, (1, 1), mat_element(5, bytes(4))),
    ):  # fmt: skip
        yield header + mat_array(name, kind, sides, data)
    deep = mat_array("", 6, (1, 1), mat_element(9, bytes(8)))
    for _ in range(300):
        deep = mat_array(name, 1, (1, 1), deep)
    yield header + deep
    many = mat_element(14, b"") * 400_000
    yield header + mat_array(name, 1, (400_000, 1), many)
    head = struct.pack("<2I", 14, BOMB + 56) + mat_array(name, 6, (BOMB, 1), mat_element(2, b""))[8:]
    packed = zeros(head[:-8] + struct.pack("<2I", 2, BOMB))
    yield header + struct.pack("<2I", 15, len(packed)) + packed


def hdf5() -> Iterator[bytes]:
    """Return label files of IDIAP whose fields refer to other files, or are larger than the memory."""

    def written(write: Callable[[h5py.Group], object]) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "a.mat"
            with h5py.File(file, "w") as content:
                for split in ("train", "test"):
                    write(content.create_group(f"or_label_{split}"))
            return file.read_bytes()

    def fields(group: h5py.Group, **how: Any) -> None:
        for name in ("pan", "tilt", "roll", "name"):
            group.create_dataset(name, **how)

    yield written(lambda group: fields(group, shape=(10**6, 10**6), dtype="f8"))
    yield written(lambda group: fields(group, shape=(10**6, 10**6), dtype="f8", chunks=(10**4, 10**4)))
    yield written(
        lambda group: fields(
            group, shape=(1, 1), maxshape=(None, None), dtype="u2", chunks=(2**14, 2**16), compression="gzip"
        )
    )
    yield written(lambda group: fields(group, shape=(8,), dtype="u1", external=[("/etc/passwd", 0, 8)]))
    yield written(lambda group: fields(group, shape=(10**7,), dtype=h5py.ref_dtype, chunks=(10**4,)))
    yield written(lambda group: fields(group, shape=(1,), dtype=h5py.string_dtype()))
    yield written(
        lambda group: [
            group.__setitem__(name, h5py.ExternalLink("/proc/self/exe", "/a")) for name in ("pan", "tilt")
        ]
    )
    layout = h5py.VirtualLayout((8,), "u1")
    layout[:] = h5py.VirtualSource("/etc/passwd", "a", (8,))
    yield written(
        lambda group: [group.create_virtual_dataset(name, layout) for name in ("pan", "tilt", "roll", "name")]
    )


PICKLES = [
    b"}K\x01\x85" + b"2\x86" * 40 + b"Ns.",
    b"\x8f(K\x01\x85" + b"2\x86" * 40 + b"\x90.",
    b"(K\x01\x85" + b"2\x86" * 40 + b"\x91.",
    b"](" + b"}" * 10**6 + b"e.",
    b"]" * 10**5 + b"a" * (10**5 - 1) + b".",
    b"](X\x00\x00\x10\x00"
    + b"a" * 2**20
    + b"q\x000"
    + b"c_codecs\nencode\nh\x00X\x06\x00\x00\x00latin1\x86R" * 5000
    + b"e.",
    b"Nr\xff\xff\xff\xff.",
    b"\x8e\xff\xff\xff\xff\xff\xff\xff\x0fabc.",
    b"cos\nsystem\n(U\x02idtR.",
    b"I" + b"9" * 10**5 + b"\n.",
]


def yaml_bomb() -> bytes:
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    for one, other in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{other}: &{other} [{', '.join([f'*{one}'] * 9)}]")
    return "\n".join(lines).encode()


def yamls(whole: bytes) -> Iterator[bytes]:
    yield yaml_bomb()
    yield b"a: " + b"[" * 50_000
    yield b"a: " + b"{b: " * 50_000
    yield b"- " * 40_000
    yield b"? " * 40_000
    yield b"a: b\n" * 10**6
    yield b"a: &a\n  <<: *a\n"
    yield b"a: " + b"x" * 10**5
    yield b"'" + b"a" * 10**5
    yield b"a: !!python/object/apply:os.system [id]\n"
    yield b"a: !unknown {b: 1}\n"
    yield b"a: !!binary =====\n"
    yield b"a: 2001-99-99\n"
    yield b"a: " + b"9" * 10**5
    yield b"a: 1" + b":59" * 30_000
    yield b"\xff\xfe\0\0"
    yield b"[]"
    yield b"null"
    yield b"1: 2"
    for more in (
        "callbacks: [x]",
        "logger: true",
        "plugins: [a]",
        "default_root_dir: /",
        "enable_checkpointing: true",
    ):
        yield whole.replace(b"  max_epochs: 3\n", f"  max_epochs: 3\n  {more}\n".encode())
    yield whole.replace(b"name: moons", b"name: moons\n  _target_: os.system")
    yield whole.replace(b"name: moons", b"name: ../../etc")


JSONS = [
    b"[" * 10**5,
    b'{"a":' * 10**5,
    b"9" * 10**5,
    b'{"n":' + b"9" * 5000 + b"}",
    b"null",
    b"[]",
    b'"x"',
    b"{}",
    b" " * 2**25,
]
SAME_TUPLE_TWICE = b"\x80\x02}K\x01\x85q\x00" + b"".join(
    b"h%ch%c\x86q%c" % (number, number, number + 1) for number in range(40)
)
"""Pickled tuple of tuples, forty levels deep, in which each level repeats the next."""
JOURNALS = [
    b'{"n":1,"values":{"a":{}},"time":0,"step":0,"epoch":0}\n', b'{"n":1,"values":[1],"time":0}\n',
    b'{"n":-5,"values":{}}\n',
    b'{"n":1,"a":' + b"[" * 10**5 + b"\n", b'{"n":9' + b"9" * 5000 + b"}\n", b"\n" * 10**6,
    b'{"n":1,"values":{"a":"9"}}\n',
]  # fmt: skip


def checkpoints(whole: bytes, signed: Callable[[bytes], bytes]) -> Iterator[bytes]:
    """Checkpoints with the right checksum: of no model, without a key, or compressed."""
    described = torch.load(io.BytesIO(whole), weights_only=True)
    odd: list[Any] = [None, [], {}, 1, "x", {"framework": None}, {"framework": {"format": torch.zeros(2)}}]
    odd += [{**described, "framework": {"format": 1}}, {"framework": described["framework"]}]
    for key, value in (
        ("config", {}), ("config", []), ("config", {"encoder": [{}]}), ("target", {}),
        ("target", {"kind": "class", "names": 5}),
        ("target", {"kind": ["a"], "names": ["a", "b"]}), ("target", {"kind": "class", "names": [1, None]}),
        ("input_shape", 3),
        ("input_shape", [10**12]), ("input_shape", [-3]), ("input_shape", ["a"]), ("input_shape", []), ("columns", 7),
    ):  # fmt: skip
        odd.append({**described, "framework": {**described["framework"], key: value}})
    for value in (None, [], {"predictor.a": 1}, {1: 2}, {"predictor.x": torch.zeros(1).to_sparse()}):
        odd.append({**described, "state_dict": value})
    for one in odd:
        packed = io.BytesIO()
        torch.save(one, packed)
        yield signed(packed.getvalue())
    yield signed(deflated_part("archive/data.pkl", zeros(), BOMB))
    pickled = SAME_TUPLE_TWICE + b"Ns."
    yield signed(
        zip_of({"archive/data.pkl": pickled, "archive/version": b"3\n", "archive/byteorder": b"little"})
    )
    yield signed(b"")
    yield signed(b"\x80\x02}K\x01\x85" + b"2\x86" * 10 + b"Ns.")
    yield signed(json.dumps({"framework": 1}).encode())


def sha(content: bytes) -> bytes:
    """Return the content with the checksum of a checkpoint."""
    return content + MARK + hashlib.sha256(content).digest()


TEXTS = [
    b"pan = 1e999\nvalid = 1\n",
    b"pan = \xd9\xa1\nvalid = 1\n",
    b"pan = 1\nvalid = " + b"x" * 10**6,
    b"a b c " * 10**5,
    b"\0" * 10**6,
]


def motions(whole: bytes) -> list[bytes]:
    """Return faulty variants of a BVH file: wrong counts, misplaced brackets, and texts in the place of numbers."""
    changes = [
        (b"CHANNELS 3", b"CHANNELS -2"), (b"CHANNELS 3", b"CHANNELS 99999999999"), (b"CHANNELS 3", b"CHANNELS 3_0"),
        (b"Zrotation", b"Qrotation"), (b"Zrotation", b"Yrotation"), (b"Zrotation", b"Wrotation"), (b"Spine", b""),
        (b"OFFSET 0 1.5 0", b"OFFSET nan inf 1e400"), (b"ROOT Hips\n{", b"ROOT Hips\n}"), (b"ROOT Hips\n", b""),
        (b"JOINT Spine", b"ROOT Spine"), (b"End Site\n{", b"End Site\n"), (b"Frames: 3", b"Frames: -3"),
        (b"Frames: 3", b"Frames: 99999999999"), (b"0.0083", b"1e-320"), (b"0.0083", b"-1"), (b"8.5", b"1e300"),
        (b"JOINT", b"JOINT a { JOINT " * 50_000 + b"JOINT"),
    ]  # fmt: skip
    return [whole.replace(old, new) for old, new in changes]


SAFETENSORS = [
    struct.pack("<Q", 2**63) + b"{}", struct.pack("<Q", 10**6) + b"{", struct.pack("<Q", 10**5) + b"[" * 10**5,
    struct.pack("<Q", 64) + b'{"a":{"dtype":"F32","shape":[1000000000000],"data_offsets":[0,4]}}'[:64],
]  # fmt: skip


def niftis(whole: bytes) -> Iterator[bytes]:
    """Return NIfTI-1 images with a wrong declared size, a wrong data offset, or a scale of 0."""
    most = 2**15 - 1
    for place, packed in (
        (40, struct.pack("<8h", 4, most, most, most, most, 1, 1, 1)),
        (40, struct.pack("<8h", 7, *[most] * 7)),
        (40, struct.pack("<8h", 4, -1, 2, 3, 4, 1, 1, 1)),
        (40, struct.pack("<8h", 0, *[1] * 7)),
        (70, struct.pack("<h", 1536)),
        (70, struct.pack("<h", 128)),
        (70, struct.pack("<h", 32)),
        (108, struct.pack("<f", 1e30)),
        (108, struct.pack("<f", -9.0)),
        (108, struct.pack("<f", float("nan"))),
        (112, struct.pack("<2f", float("nan"), float("inf"))),
        (112, struct.pack("<2f", 1e38, 1e38)),
        (348, b"\1\0\0\0" + struct.pack("<2i", 2**31 - 16, 4)),
        (348, b"\1\0\0\0" + struct.pack("<2i", 0, 4)),
    ):
        yield whole[:place] + packed + whole[place + len(packed) :]
    yield whole[:348]
