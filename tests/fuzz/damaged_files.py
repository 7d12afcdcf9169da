"""Undamaged files of every format, and damage inside checksums and compression."""

import gzip
import hashlib
import io
import pickle
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import nibabel
import numpy as np
import pyarrow as pa
import scipy.io
import torch
import yaml
from PIL import Image
from pyarrow import parquet
from scipy import sparse

from framework.configuration import loading
from framework.configuration.assembly import build_predictor
from framework.configuration.schema import resolve
from framework.storage.checkpoints import MARK, TRAILER
from framework.target import Target
from framework.testing import sample_files
from framework.tracking.journal import Journal
from framework.tracking.run_info import RunInfo, Sidecar
from framework.training.checkpoint import WholeCheckpoints
from plugins.data.head_pose import idiap_labels, roots
from tests.fuzz.damage import Damage, spoilt

RANDOM = np.random.default_rng(0)


# ---- damage inside what is checked first --------------------------------------------------------------------------


def in_zip(content: bytes, random: np.random.Generator) -> bytes:
    """Damage one part of a zip archive, and make its checksum right."""
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(packed, "w") as made:
        chosen = int(random.integers(len(archive.infolist())))
        for number, part in enumerate(archive.infolist()):
            inner = archive.read(part)
            made.writestr(
                part.filename, spoilt(inner, random) if number == chosen else inner, part.compress_type
            )
    return packed.getvalue()


def parquets() -> list[bytes]:
    """Return the same table with the encodings and compressions that programs choose."""
    table = pa.table(
        {
            "a": [1.0, None, -1e3, 4.0] * 5,
            "b": pa.array([2, 3, None, 5] * 5, pa.int16()),
            "c": ["x", "y", None, "z\nw"] * 5,
            "d": pa.array(["x", "y", "x", None] * 5).dictionary_encode(),
            "e": [True, None, False, False] * 5,
            "f": pa.array([1, 2, None, 4] * 5, pa.timestamp("ms")),
            "g": [[1], [2, 3], [], None] * 5,
        }
    )
    files = []
    for compression in ("none", "snappy", "zstd", "gzip"):
        for version, dictionary in (("1.0", True), ("2.0", False)):
            stream = io.BytesIO()
            parquet.write_table(
                table, stream, compression=compression, data_page_version=version, use_dictionary=dictionary
            )
            files.append(stream.getvalue())
    return files


def in_png(content: bytes, random: np.random.Generator) -> bytes:
    """Damage one chunk of a PNG, and make its length and checksum right; pixels are damaged in their decompressed
    form."""
    chunks, place = [], 8
    while place < len(content):
        (length,) = struct.unpack_from(">I", content, place)
        chunks.append((content[place + 4 : place + 8], content[place + 8 : place + 8 + length]))
        place += 12 + length
    damage_part(chunks, b"IDAT", random)
    made = content[:8]
    for kind, data in chunks:
        made += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return made


def in_gzip(content: bytes, random: np.random.Generator) -> bytes:
    """Damage the content inside a gzip file, and pack it again with a right checksum."""
    return gzip.compress(spoilt(gzip.decompress(content), random), 1)


def in_mat(content: bytes, random: np.random.Generator) -> bytes:
    """Damage one compressed variable of a MATLAB 5 file, and compress it again."""
    variables, place = [], 128
    while place < len(content):
        kind, size = struct.unpack_from("<II", content, place)
        variables.append((kind, content[place + 8 : place + 8 + size]))
        place += 8 + size
    damage_part(variables, 15, random)
    made = content[:128]
    for kind, data in variables:
        made += struct.pack("<II", kind, len(data)) + data
    return made


def damage_part(parts: list[tuple[Any, bytes]], packed: Any, random: np.random.Generator) -> None:
    """Damage one of the parts (kind, content) of a file; the content of the kind `packed` in its decompressed form."""
    chosen = int(random.integers(len(parts)))
    kind, data = parts[chosen]
    damaged = zlib.compress(spoilt(zlib.decompress(data), random)) if kind == packed else spoilt(data, random)
    parts[chosen] = kind, damaged


def signed(inner: Damage) -> Damage:
    """Damage the content of a checkpoint, and make its checksum right."""

    def damage(content: bytes, random: np.random.Generator) -> bytes:
        made = inner(content[:-TRAILER], random)
        return made + MARK + hashlib.sha256(made).digest()

    return damage


def in_values(content: bytes, random: np.random.Generator) -> bytes:
    """Write a checkpoint again, with one value removed or replaced."""
    values = torch.load(io.BytesIO(content[:-TRAILER]), weights_only=True)
    odd = (None, -1, 10**12, 0.5, "x" * 5000, [], {}, [[]], {"name": "mlp"}, torch.zeros(2, 3), True, [10**9])
    for _ in range(int(random.integers(1, 3))):
        place: Any = values
        while True:
            key = (
                list(place)[int(random.integers(len(place)))]
                if isinstance(place, dict)
                else int(random.integers(len(place)))
            )
            inner = place[key]
            if not isinstance(inner, dict | list) or not inner or random.random() < 0.3:
                break
            place = inner
        if isinstance(place, dict) and random.random() < 0.4:
            del place[key]
            if not place:
                break
        else:
            place[key] = odd[int(random.integers(len(odd)))]
    packed = io.BytesIO()
    torch.save(values, packed)
    return packed.getvalue() + MARK + hashlib.sha256(packed.getvalue()).digest()


# ---- whole files --------------------------------------------------------------------------------------------------


def written(name: str, write: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        write(file)
        return file.read_bytes()


def saved(write: Callable[[io.BytesIO], object]) -> bytes:
    stream = io.BytesIO()
    write(stream)
    return stream.getvalue()


def npy(array: Any) -> bytes:
    return saved(lambda stream: np.save(stream, array))


def npz(*, packed: bool = False, **arrays: Any) -> bytes:
    return saved(lambda stream: (np.savez_compressed if packed else np.savez)(stream, **arrays))


def mat(packed: bool, **content: Any) -> bytes:
    return saved(lambda stream: scipy.io.savemat(stream, content, do_compression=packed))


VERTICES, FACES = sample_files.surface(0, 4)
COLOURS = RANDOM.integers(0, 256, (len(VERTICES), 3))


def ply_binary(order: str, name: str) -> bytes:
    head = [
        "ply", f"format {name} 1.0", "comment of nobody", f"element vertex {len(VERTICES)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        f"element face {len(FACES)}", "property list uchar int vertex_indices", "property float quality", "end_header",
    ]  # fmt: skip
    content = "\n".join([*head, ""]).encode()
    for point, colour in zip(VERTICES, COLOURS, strict=True):
        content += struct.pack(f"{order}3d3B", *point, *colour.tolist())
    for face in FACES:
        content += struct.pack(f"{order}B3if", 3, *face.tolist(), 0.5)
    return content


def obj() -> bytes:
    lines = ["# a surface", "mtllib none.mtl", *(f"v {x} {y} {z} 0.5 0.2 1" for x, y, z in VERTICES.tolist())]
    lines += [f"f {a + 1}/1/1 {b + 1} {c + 1}" for a, b, c in FACES.tolist()] + ["f -1 -2 -3 -4"]
    return "\n".join(lines).encode()


def stl_text() -> bytes:
    lines = ["solid one"]
    for face in FACES:
        corners = [f"vertex {x} {y} {z}" for x, y, z in VERTICES[face].tolist()]
        lines += ["facet normal 0 0 1", "outer loop", *corners, "endloop", "endfacet"]
    return "\n".join([*lines, "endsolid one"]).encode()


def stl_binary() -> bytes:
    content = bytes(80) + struct.pack("<I", len(FACES))
    return content + b"".join(
        struct.pack("<12fH", 0, 0, 1, *VERTICES[face].ravel().tolist(), 0) for face in FACES
    )


def xyz() -> bytes:
    rows = np.column_stack([VERTICES, COLOURS]).tolist()
    return ("x y z red green blue\n" + "\n".join(" ".join(map(str, row)) for row in rows)).encode()


def las_files() -> list[bytes]:
    """Return a cloud in LAS, without and with colours, times and an attribute of several numbers."""
    files = []
    for version, number in (("1.2", 0), ("1.2", 3), ("1.4", 7)):
        header = laspy.LasHeader(point_format=number, version=version)
        header.scales, header.offsets = np.full(3, 0.001), VERTICES.mean(0).round()
        if number == 7:
            header.add_extra_dim(laspy.ExtraBytesParams("pair", "2f4"))
        scan = laspy.LasData(header)
        scan.x, scan.y, scan.z = VERTICES.T
        scan.classification = np.arange(len(VERTICES)) % 5
        stream = io.BytesIO()
        scan.write(stream)
        files.append(stream.getvalue())
    return files


def bvh() -> bytes:
    """BVH file of two joints and three frames."""
    turns = "CHANNELS 3 Zrotation Yrotation Xrotation"
    head = [
        "HIERARCHY", "ROOT Hips", "{", "OFFSET 0 0 0", "CHANNELS 6 Xposition Yposition Zposition " + turns[11:],
        "JOINT Spine", "{", "OFFSET 0 1.5 0", turns, "End Site", "{", "OFFSET 0 1 0", "}", "}", "}",
        "MOTION", "Frames: 3", "Frame Time: 0.0083",
    ]  # fmt: skip
    rows = [" ".join(f"{row * 9 + column}.5" for column in range(9)) for row in range(3)]
    return "\n".join([*head, *rows, ""]).encode()


def image(kind: str, mode: str = "RGB", **how: Any) -> bytes:
    picture = Image.fromarray(RANDOM.integers(0, 256, (20, 24, 3), np.uint8)).convert(mode)
    return saved(lambda stream: picture.save(stream, kind, **how))


def coil() -> bytes:
    pixels = np.zeros((1440, 1024), np.uint8)
    return mat(True, X=pixels, Y=np.repeat(np.arange(1, 21), 72)[:, None].astype(np.uint8))


def annotation(packed: bool) -> bytes:
    view = {"azimuth": 30.0, "elevation": 10.0, "theta": -2.0, "distance": 3.0, "azimuth_coarse": 45.0}
    one = {
        "class": "car",
        "bbox": [3.0, 4.0, 50.0, 60.0],
        "viewpoint": view,
        "truncated": 0,
        "occluded": 1,
        "difficult": 0,
    }
    objects = np.empty((1, 2), dtype=[(name, object) for name in one])
    for number in range(2):
        objects[0, number] = tuple(one.values())
    return mat(packed, record={"filename": "one.jpg", "objects": objects, "imgsize": [100, 80, 3]})


def caviar(packed: bool) -> bytes:
    rows = [roots.caviar_row(number) for number in range(6)]
    return mat(
        packed,
        or_label_train=roots.struct_array(rows[:4]),
        or_label_test=roots.struct_array(rows[4:]),
        other=3,
    )


def idiap(count: int) -> bytes:
    rows = [roots.idiap_row(number) for number in range(count)]
    return written(
        "a.mat",
        lambda file: roots.save_idiap(file, or_label_train=rows, or_label_test=rows[: max(count // 2, 1)]),
    )


def idiap_of_ours() -> bytes:
    labels = [idiap_labels.Label(f"head_{number}.jpg", (0.1 * number, 0.2, 0.3)) for number in range(4)]
    return written(
        "a.mat", lambda file: idiap_labels.write_labels(file, {"train": labels, "test": labels[:2]})
    )


def body() -> dict[str, Any]:
    joints, vertices, shapes = 3, 6, 2
    weights = RANDOM.random((vertices, joints))
    return {
        "v_template": RANDOM.normal(size=(vertices, 3)), "shapedirs": RANDOM.normal(size=(vertices, 3, shapes)),
        "posedirs": RANDOM.normal(size=(vertices, 3, 9 * (joints - 1))),
        "J_regressor": np.full((joints, vertices), 1 / vertices),
        "weights": weights / weights.sum(1, keepdims=True), "f": RANDOM.integers(0, vertices, (5, 3)).astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, 0, 1], [0, 1, 2]], dtype=np.uint32),
    }  # fmt: skip


def body_pickles() -> list[bytes]:
    content = body()
    loose = [{**content, "J_regressor": make(content["J_regressor"]), "bs_type": "lrotmin", "names": {"a": [1, 2.5]}}
             for make in (sparse.csc_matrix, sparse.csr_matrix, sparse.coo_matrix)]  # fmt: skip
    return [pickle.dumps(one, protocol=protocol) for one in loose for protocol in (1, 2, 4, 5)]


def dales(packed: bool) -> bytes:
    points = RANDOM.normal(size=(30, 3))
    return npz(
        packed=packed, points=points, offset=np.array([0, 10, 30]), label=np.array([0, 1]),
        object_id=np.array([5, 6]), classes=np.array(["tree", "car"]),
    )  # fmt: skip


def z_spectra() -> dict[str, Any]:
    """Return Z-spectra of 3 × 4 voxels in two regions, 2 voxels of them outside the mask."""
    offsets = np.linspace(-4.0, 4.0, 9)
    lines = 1 - 0.8 / (1 + offsets**2)
    mask, region = np.ones((3, 4)), np.zeros((3, 4))
    mask[0, :2], region[1:, 2:] = 0, 1
    height = RANDOM.uniform(0.5, 2, (3, 4))
    return {
        "spectra": height[..., None] * lines, "offsets": offsets, "M0": height, "mask": mask, "region": region,
    }  # fmt: skip


def nifti(array: np.ndarray) -> bytes:
    return nibabel.Nifti1Image(array.reshape(3, 4, 1, *array.shape[2:]), np.eye(4)).to_bytes()


def flight() -> np.ndarray:
    """(9, 4): t, x, y, z."""
    time = 0.016 * np.arange(9)
    return np.stack([time, 3 * time, -2 * time, 0.3 + time - 4.9 * time**2], -1)


def checkpoint() -> bytes:
    resolved = {
        "encoder": [resolve("encoder", {"name": "mlp", "widths": [4], "dropout": 0.1})],
        "density_head": resolve("density_head", "categorical"), "uncertainty": [], "data": {"name": "moons"},
    }  # fmt: skip
    model = build_predictor(resolved, Target("class", ("a", "b")), (3,), 0)
    described = {
        "format": 1, "version": "1", "config": resolved, "target": {"kind": "class", "names": ["a", "b"]},
        "input_shape": [3], "columns": ["x", "y", "z"], "synthetic": True,
    }  # fmt: skip
    state = {f"{loading.PREFIX}{name}": value for name, value in model.state_dict().items()}
    content = {"framework": described, "state_dict": state, "epoch": 1}
    return written("a.ckpt", lambda file: WholeCheckpoints().save_checkpoint(content, file))


def run_json() -> bytes:
    info = RunInfo(
        "1" * 32, "sqlite:///x", "e", "r", None, None, "key", 0.5, "KILLED", owed=(("a.png", "b"),)
    )
    return written(
        "run.json", lambda file: Sidecar(file.parent, info).update(sent=4, replay_until={"loss": 3})
    )


def journal() -> bytes:
    def write(file: Path) -> None:
        made = Journal(file)
        for step in range(12):
            made.write({"train/loss": 0.5 / (step + 1), "bad": float("nan")}, step, step // 4)
        made.append(tags={"a": "b"})
        made.close()

    return written("journal.jsonl", write)


def config() -> bytes:
    values = {
        "data": {"name": "moons"}, "outliers": None, "encoder": {"mlp": {"name": "mlp", "widths": [16, 8]}},
        "density_head": {"name": "categorical"}, "uncertainty": {}, "objective": {}, "metric": {}, "renderer": None,
        "optimizer": {"name": "adamw", "learning_rate": 1e-3}, "trainer": {"max_epochs": 3, "accelerator": "cpu"},
        "logger": {"name": "none"}, "mode": {"name": "train"}, "seed": 0, "batch_size": 64, "resume": "auto",
    }  # fmt: skip
    return yaml.safe_dump(values, sort_keys=False).encode()
