"""Small files that would need much memory or time, each read in a separate process: `python -m tests.exhausting
<what>`.

Prints a line of JSON for each: what it was, how it ended, processor seconds and peak megabytes.
"""

import copy
import gzip
import io
import json
import math
import os
import resource
import signal
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

import framework
from framework.configuration.assembly import build_predictor
from framework.configuration.composition import in_quotes
from framework.configuration.loading import PREFIX
from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.datasets.csv_columns import read_columns
from framework.datasets.images import Crop
from framework.density_head import Fitted
from framework.distributions.protocol import median
from framework.errors import UserError, shorten
from framework.geometry import meshes
from framework.model import fitted_models
from framework.storage import checkpoints, text
from framework.storage.arrays import map_npy
from framework.storage.names import spell_name
from framework.target import Target
from framework.testing.contract import contract
from framework.tracking.stores import require_no_password, without_password
from tests.fuzz.crafted_files import plain_png

HUGE = (20_000, 30_000_000)
"""Values that replace each whole number of a config."""
LONG = 5000
REALS = Target("real", ("x", "y"))
SECONDS = 10.0
"""Limit of the processor time of one case, seconds."""
MUCH = 450.0
"""Memory that a case leaves behind, after which the next case runs in another process, megabytes."""
Case = tuple[str, Callable[[], object], Callable[[], object]]
"""Name of a case, what prepares it and does not count, and what is measured."""


def case(name: str, action: Callable[[], object]) -> None:
    """Run a function in a fork, and print its outcome: "done", an error message, or another exception."""
    cases([(name, lambda: None, action)])


def cases(pending: Sequence[Case]) -> None:
    """Run functions one after another in a fork, and print the outcome of each.

    A fork of this large process costs more than most functions. The peak of the memory is reset before each function,
    so that it is the function's own. The remaining functions run in another fork after one that was killed, and after
    one that left much memory behind.
    """
    while pending:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                for name, prepare, action in pending:
                    prepare()
                    line = outcome(name, action)
                    os.write(writing, json.dumps(line).encode() + b"\n")
                    if megabytes("VmRSS") > MUCH:
                        break
            finally:
                os._exit(0)
        os.close(writing)
        with os.fdopen(reading, "rb") as stream:
            lines = stream.read().decode().splitlines()
        _, status, used = os.wait4(child, 0)
        if len(lines) < len(pending) and (status != 0 or not lines):
            seconds, peak = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
            name = pending[len(lines)][0]
            killed = {"case": name, "ended": "killed", "seconds": seconds, "megabytes": peak}
            lines.append(json.dumps(killed))
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        sys.stdout.flush()
        pending = pending[len(lines) :]


def outcome(name: str, action: Callable[[], object]) -> dict[str, Any]:
    """Run a function, and return how it ended, its processor time and the peak memory of this process meanwhile."""
    Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM (proc_pid_clear_refs(5))
    before = processor_seconds()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        action()
        ended = "done"
    except UserError as error:
        ended = f"sentence: {error}"
    except BaseException as error:
        ended = f"raised: {type(error).__name__}: {error}"
    signal.setitimer(signal.ITIMER_PROF, 0)
    seconds = processor_seconds() - before
    return {"case": name, "ended": ended[:2000], "seconds": seconds, "megabytes": megabytes("VmHWM")}


def megabytes(entry: str) -> float:
    """Return the memory of this process: "VmRSS" now, or "VmHWM" at its peak since the peak was reset."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{entry}:"))


def processor_seconds() -> float:
    """Return the processor time of this process and of those that it has waited for."""
    return sum(os.times()[:4])


@dataclass
class Model:
    """Small model that contains one plugin, and the place of this plugin in the config."""

    name: str
    config: dict[str, Any]
    target: Target
    input_shape: tuple[int, ...]
    columns: tuple[str, ...]
    inputs: torch.Tensor | None
    place: tuple[Any, ...]

    def write(self, file: Path, weights: dict[str, torch.Tensor], config: Any = None, **fields: Any) -> None:
        described = {"format": 1, "config": config or self.config, "target": asdict(self.target)}
        described |= {"input_shape": self.input_shape, "columns": self.columns, **fields}
        state = {PREFIX + key: value for key, value in weights.items()}
        checkpoints.write({"framework": described, "state_dict": state}, file)

    def weights(self) -> dict[str, torch.Tensor]:
        made = build_predictor(self.config, self.target, self.input_shape, 0, self.columns)
        for model in fitted_models(made):
            features, classes = torch.randn(40, *self.input_shape), torch.arange(40) % len(self.target.names)
            wanted = classes if self.target.kind == "class" else torch.randn(40, *self.target.event_shape)
            model.head.fit(features, wanted, 0)  # type: ignore[operator]
        return made.state_dict()


def models(only: str = "") -> Iterator[Model]:
    """Yield a model for each row of every plugin that can be part of a model, and for each kind of data; or only for
    the named plugin, such as "encoder mlp"."""

    def names(group: str) -> list[str]:
        return [name for name in installed(group) if only in ("", f"{group} {name}")]

    mlp = resolve("encoder", {"name": "mlp", "widths": [8], "dropout": 0.1})
    plain = {"data": resolve("data", "moons"), "encoder": [mlp], "uncertainty": []}
    plain |= {"density_head": resolve("density_head", "gaussian"), "objective": [], "metric": []}
    for name in names("data"):
        config = plain | {"data": resolve("data", {"name": name, **contract("data", name).rows[0].config})}
        yield Model(f"data {name}", config, REALS, (6,), (), None, ("data",))
    for name in names("encoder"):
        for row in contract("encoder", name).rows:
            part = resolve("encoder", {"name": name, **row.config})
            config = plain | {"encoder": [part, mlp]}
            shape, columns = row.input_shape, row.columns  # type: ignore[union-attr]
            inputs = row.inputs(1) if row.inputs else torch.rand(1, *shape)  # type: ignore[union-attr]
            yield Model(f"encoder {name}", config, REALS, shape, columns, inputs, ("encoder", 0))
    for name in names("density_head"):
        for row in contract("density_head", name).rows:
            part = resolve("density_head", {"name": name, **row.config})
            head: Any = build("density_head", part, target=row.target)  # type: ignore[union-attr]
            alone = head.direct or isinstance(head, Fitted)
            shape = (getattr(head, "size", 0) or 6,) if alone else (6,)
            config = plain | {"density_head": part, "encoder": [] if alone else [mlp]}
            target = row.target  # type: ignore[union-attr]
            yield Model(
                f"density_head {name}", config, target, shape, (), torch.rand(1, *shape), ("density_head",)
            )
    heads = {"class": "categorical", "angle": "von_mises", "real": "gaussian"}
    for name in names("uncertainty"):
        for row in contract("uncertainty", name).rows:
            part = resolve("uncertainty", {"name": name, **row.config})
            target = row.target  # type: ignore[union-attr]
            head = resolve("density_head", heads[target.kind])
            config = plain | {"density_head": head, "uncertainty": [part]}
            yield Model(f"uncertainty {name}", config, target, (6,), (), torch.rand(1, 6), ("uncertainty", 0))


def predicted(file: Path, inputs: torch.Tensor | None) -> None:
    """Load a model of somebody else, and predict with it."""
    model = framework.load(file)
    if inputs is not None:
        density = model(inputs)
        median(density, 100) if len(density.event_shape) < 3 else density.mean


def numbers(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], list[Any]]]:
    """Yield the place of each number and list in a config, with the values to try there."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from numbers(item, (*place, key))
    elif isinstance(value, list):
        if value:
            yield place, [value * (LONG // len(value))]
            yield from numbers(value[0], (*place, 0))
    elif isinstance(value, int) and not isinstance(value, bool):
        yield place, list(HUGE)
    elif isinstance(value, float):
        yield place, [1e9]


def put(config: Any, place: tuple[Any, ...], value: Any) -> Any:
    config = copy.deepcopy(config)
    here = config
    for key in place[:-1]:
        here = here[key]
    here[place[-1]] = value
    return config


def stored_parameters(folder: Path) -> None:
    """Write checkpoints of small models in which one number of the config is too large, for every number of every
    plugin."""
    file, seen = folder / "model.ckpt", set()
    for model in models():
        part = model.config
        for key in model.place:
            part = part[key]
        asked = [(place, values) for place, values in numbers(part) if (model.name, *place) not in seen]
        seen |= {(model.name, *place) for place, _ in asked}
        if not asked:
            continue
        weights = model.weights()
        if sum(weight.nbytes for weight in weights.values()) > 2**24:
            continue  # no small file: its weights account for 1 GB
        model.write(file, weights)
        with suppress(UserError):  # a data set may miss what travels with a model of its own
            predicted(file, model.inputs)  # what is imported and compiled once is not part of a case
        pending = list[Case]()
        for place, values in asked:
            for value in values:
                said = f"{len(value)} items" if isinstance(value, list) else value
                name = f"{model.name} {'.'.join(map(str, place))} = {said}"
                config = put(model.config, (*model.place, *place), value)
                prepare = partial(model.write, file, weights, config)
                pending.append((name, prepare, partial(predicted, file, model.inputs)))
        cases(pending)


def stored_fields(folder: Path) -> None:
    """Write checkpoints whose input shape, target or other descriptions are far too large."""
    model = next(models("encoder mlp"))
    weights, file = model.weights(), folder / "model.ckpt"
    target, many = asdict(model.target), [f"x{number}" for number in range(110_000)]
    for name, fields in {
        "a long input": {"input_shape": (10**9,)},
        "an input of a million": {"input_shape": (1_000_000,)},
        "a large image": {"input_shape": (3, 20_000, 20_000)},
        "an input of many sides": {"input_shape": [1] * 100_000},
        "a negative side": {"input_shape": (-(10**9), -6)},
        "many names": {"target": target | {"names": many}},
        "many classes": {"target": target | {"kind": "class", "names": many[:90_000]}},
        "many reals": {"target": target | {"names": many[:90_000]}},
        "a long name": {"target": target | {"names": ("x" * 10**6, "y")}},
        "a large picture": {"target": target | {"kind": "image", "size": (60_000, 60_000)}},
        "a picture of 100 MB": {"target": target | {"kind": "image", "size": (3000, 4000)}},
        "many columns": {"columns": many},
        "many samples": {"settings": {"samples": 10**9}},
        "a wrong number of samples": {"settings": {"samples": -1}},
        "a large batch": {"settings": {"batch_size": 10**12}},
        "a seed beyond all": {"settings": {"seed": 10**30}},
    }.items():
        model.write(file, weights, **fields)
        case(name, partial(predicted, file, model.inputs))


def image(mode: str, size: tuple[int, int], kind: str, **options: Any) -> bytes:
    content = io.BytesIO()
    quick = {"compress_level": 1} if kind == "PNG" else {}
    Image.new(mode, size).save(content, kind, **quick, **options)
    return content.getvalue()


def array(shape: tuple[int, ...], kind: str, content: bytes) -> bytes:
    """Return the bytes of an .npy file."""
    header = io.BytesIO()
    described = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(header, described)
    return header.getvalue() + content


def archive(**arrays: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        for name, one in arrays.items():
            packed.writestr(f"{name}.npy", one)
    return content.getvalue()


def matlab(name: bytes, shape: tuple[int, int], content: bytes) -> bytes:
    """Return a compressed variable of bytes in a MATLAB 5 file."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    head = element(6, struct.pack("<II", 9, 0)) + element(5, struct.pack("<2i", *shape)) + element(1, name)
    packed = zlib.compress(element(14, head + element(2, content)), 1)
    return struct.pack("<II", 15, len(packed)) + packed


def icon(picture: bytes) -> bytes:
    """Return an icon with one image, which is larger than the directory says."""
    return struct.pack("<HHHBBBBHHII", 0, 1, 1, 0, 0, 0, 0, 1, 32, len(picture), 22) + picture


def idx(*shape: int) -> bytes:
    """Return a packed idx file of zeros."""
    header = bytes([0, 0, 8, len(shape)]) + b"".join(side.to_bytes(4, "big") for side in shape)
    return gzip.compress(header + bytes(math.prod(shape)), 1)


def scene(count: int, mode: int = 4, nodes: int = 1, sets: int = 0) -> bytes:
    """Return a glTF file whose accessors have no data, so that all their numbers are 0."""
    accessors = [{"componentType": 5121, "count": count, "type": kind} for kind in ("VEC3", "SCALAR", "VEC4")]
    attributes = {"POSITION": 0} | {
        f"{name}_{one}": 2 for one in range(sets) for name in ("JOINTS", "WEIGHTS")
    }
    node = {"mesh": 0, **({"skin": 0} if sets else {})}
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": list(range(nodes))}],
        "nodes": [node] * nodes,
        "skins": [{"joints": [0]}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1, "mode": mode}]}],
        "accessors": accessors,
    }
    return json.dumps(document).encode()


def textured(sides: list[tuple[int, int]]) -> bytes:
    """Return a glTF file with images of this size."""
    pictures = [image("RGB", side, "PNG") for side in sides]
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    binary, views = corners, [{"buffer": 0, "byteOffset": 0, "byteLength": 36}]
    for one in pictures:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(one)})
        binary += one
    each = range(len(sides))
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{**primitive, "material": one} for one in each]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": kind} for kind in ("VEC3", "VEC2")
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
        "images": [{"bufferView": 1 + one, "mimeType": "image/png"} for one in each],
        "textures": [{"source": one} for one in each],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": one}}} for one in each],
    }
    text = json.dumps(document).encode()
    text, binary = text + b" " * (-len(text) % 4), binary + b"\0" * (-len(binary) % 4)
    parts = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return b"glTF" + struct.pack("<II", 2, 12 + len(parts)) + parts


def tiled(side: int) -> bytes:
    """Return a TIFF file with an image of 16 x 16 pixels in one tile of `side` x `side` pixels, all zero."""
    packer = zlib.compressobj(9)
    tile = b"".join(packer.compress(bytes(side)) for _ in range(side)) + packer.flush()
    tile += bytes(len(tile) % 2)
    sizes = {256: 16, 257: 16, 258: 8, 259: 8, 262: 1, 277: 1, 322: side, 323: side, 324: 8, 325: len(tile)}
    entries = b"".join(
        struct.pack("<HHII", number, 4 if number > 300 else 3, 1, size) for number, size in sizes.items()
    )
    return (
        b"II*\0"
        + struct.pack("<I", 8 + len(tile))
        + tile
        + struct.pack("<H", len(sizes))
        + entries
        + bytes(4)
    )


def scanned(scans: int, width: int = 8688, height: int = 5784) -> bytes:
    """Return a progressive JPEG file in which each scan of some bytes passes over every pixel (end-of-band runs)."""

    def segment(marker: int, content: bytes) -> bytes:
        return bytes([0xFF, marker]) + struct.pack(">H", len(content) + 2) + content

    def coded(bits: str) -> bytes:
        bits += "1" * (-len(bits) % 8)
        return bytes(int(bits[at : at + 8], 2) for at in range(0, len(bits), 8)).replace(b"\xff", b"\xff\0")

    blocks = math.ceil(width / 8) * math.ceil(height / 8)
    one_code = bytes([1] + [0] * 15)
    head = segment(0xDB, b"\0" + b"\1" * 64) + segment(
        0xC2, struct.pack(">BHHB", 8, height, width, 1) + b"\1\x11\0"
    )
    head += segment(0xC4, b"\0" + one_code + b"\0") + segment(0xC4, b"\x10" + one_code + b"\xe0")
    first = segment(0xDA, bytes([1, 1, 0, 0, 0, 0])) + coded("0" * blocks)
    later = segment(0xDA, bytes([1, 1, 0, 1, 63, 0])) + coded(f"0{2**14 - 1:014b}" * (blocks // 32767 + 1))
    return b"\xff\xd8" + head + first + later * scans + b"\xff\xd9"


def bombs() -> dict[str, tuple[Callable[[], bytes], Callable[[Path], object]]]:
    """Yield files, each with the functions that write and read it."""
    from framework.bodies import body_files, motion
    from framework.scenes import scene_files
    from plugins.data.cest.volumes import read_volume
    from plugins.data.image_folder.labelled import LabelledImages

    def shown(file: Path) -> object:
        return Crop(file, None, 0.1, 64, 3, upright=True).read()

    offsets = array((8,), "<f8", np.linspace(-5, 5, 8).tobytes())
    bytes_in_all, side = 2**27 - 4096, 7000
    voxels = bytes_in_all // 16

    def ones() -> bytes:
        return b"\1" * bytes_in_all

    header = b"MATLAB".ljust(124) + b"\0\1IM"
    ply = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    ply += b"".join(b"property float %c\n" % axis for axis in b"xyz")
    lists = ply + b"element face 1000001\nproperty list uchar uchar vertex_indices\nend_header\n" + b"\0" * 12
    bvh = b"HIERARCHY ROOT hips { OFFSET 0 0 0 CHANNELS 3 Xrotation Yrotation Zrotation } MOTION Frames: 1000000000 "
    bvh += b"Frame Time: 0.01 "
    found: dict[str, tuple[Callable[[], bytes], Callable[[Path], object]]] = {
        "a PNG with alpha.png": (lambda: image("RGBA", (side, side), "PNG"), shown),
        "a PNG of 16 bits.png": (lambda: image("I;16", (side, side), "PNG"), shown),
        "a PNG beyond the bound.png": (lambda: plain_png(60_000, 60_000), shown),
        "a strip.png": (lambda: image("RGBA", (65_536, 700), "PNG"), shown),
        "a progressive JPEG.jpg": (lambda: image("RGB", (side, side), "JPEG", progressive=True), shown),
        "a WebP.webp": (lambda: image("RGBA", (5700, 5700), "WEBP", lossless=True, method=0), shown),
        "a TIFF of fax.tif": (lambda: image("1", (side, side), "TIFF", compression="group4"), shown),
        "tiles larger than the image.tif": (lambda: tiled(32_768), shown),
        "many scans.jpg": (lambda: scanned(8000), shown),
        "a GIF.gif": (lambda: image("P", (side, side), "GIF"), shown),
        "an icon.ico": (lambda: icon(plain_png(13_000, 13_000)), shown),
        "no marker.jpg": (lambda: b"\xff\xd8" + b"\xff" * 4_000_000, shown),
        "pixels/images-idx3-ubyte.gz": (
            lambda: idx(bytes_in_all, 1, 1),
            lambda file: LabelledImages().list_images(file.parent, 2),
        ),
        "points.npz": (
            lambda: archive(points=array((bytes_in_all // 3, 3), "|u1", ones()[: bytes_in_all // 3 * 3])),
            meshes.read,
        ),
        "wide points.npz": (
            lambda: archive(points=array((voxels, 16), "|u1", ones()[: voxels * 16])),
            meshes.read,
        ),
        "no points.npy": (lambda: array((0, 10**9), "|u1", b""), meshes.read),
        "polygons of two kinds.ply": (lambda: lists + b"\3\0\0\0" + b"\4\0\0\0\0" * 1_000_000, meshes.read),
        "a header.ply": (
            lambda: ply.replace(b"vertex 1", b"vertex 2000000000") + b"end_header\n",
            meshes.read,
        ),
        "a fan.off": (lambda: b"OFF 1 1 0\n0 0 0\n2000000 " + b"0 " * 2_000_000 + b"\n", meshes.read),
        "spectra.npz": (
            lambda: archive(spectra=array((voxels * 2, 8), "|u1", ones()[: voxels * 16]), offsets=offsets),
            read_volume,
        ),
        "one offset.npz": (
            lambda: archive(spectra=array((voxels * 16, 1), "|u1", ones()[: voxels * 16]), offsets=offsets),
            read_volume,
        ),
        "spectra.mat": (
            lambda: header + matlab(b"spectra", (voxels * 2, 8), ones()[: voxels * 16]),
            read_volume,
        ),
        "a table.csv": (lambda: b"a" + b",b" * 200_000 + b"\n", read_columns),
        "many frames.bvh": (lambda: bvh, motion.read),
        "a body.npz": (
            lambda: archive(v_template=array((voxels, 3), "|u1", ones()[: voxels * 3])),
            body_files.read,
        ),
        "triangles of nothing.gltf": (lambda: scene(10**8), scene_files.read),
        "a strip of nothing.gltf": (lambda: scene(1_600_000, 5), scene_files.read),
        "a mesh in many places.gltf": (lambda: scene(300, nodes=9000), scene_files.read),
        "many joints.gltf": (lambda: scene(100_000, sets=60), scene_files.read),
        "a large texture.glb": (lambda: textured([(8190, 8190)]), scene_files.read),
        "several textures.glb": (lambda: textured([(4096, 2048)] * 6), scene_files.read),
        "brackets.gltf": (lambda: b"[" * 1_000_000, scene_files.read),
    }
    return found


def files(folder: Path) -> None:
    """Read small files that decompress to huge content, with each reader of users' files."""
    writer = os.fork()  # what writing them takes is not part of a case
    if writer == 0:
        try:
            for name, (write, _) in bombs().items():
                (folder / name).parent.mkdir(exist_ok=True)
                (folder / name).write_bytes(write())
            (folder / "pixels" / "labels-idx1-ubyte.gz").write_bytes(idx(2**27 - 4096))
            for name in SPARSE:
                with (folder / name).open("wb") as stream:
                    stream.write(array((2**31,), "|u1", b""))
                    stream.truncate(2**32)
        finally:
            os._exit(0)
    os.waitpid(writer, 0)
    for name, (_, read) in bombs().items():
        assert 0 < (folder / name).stat().st_size < 10_000_000, name
        case(name, partial(read, folder / name))
    for name, read in SPARSE.items():
        case(name, partial(read, folder / name))


SPARSE: dict[str, Callable[[Path], object]] = {
    "a sparse array.npy": meshes.read,
    "a sparse table.csv": read_columns,
    "a sparse shard.npy": lambda file: map_npy(file).sum(),
}
"""Files of 4 GB of which 4 kB are stored, as an archive can contain them."""


def texts(folder: Path) -> None:
    """Give long texts to each function that searches the text of another person by a regular expression."""
    count = 300_000
    for function, patterns in {
        text.defuse_formulas: ("\n", "\r\n ", " ", "=(", ";"),
        text.trim: (" \u200b", "\u200b \u200b "),
        text.suggest_number: ("1,", "1 "),
        text.words_of: ("\xa0 ",),
        without_password: ("://", "://:", "://a:b@", "?", "?pass", "&pass=", "?a=", "@"),
        require_no_password: ("://", "http://", "?pass"),
        in_quotes: ("\\", "'", "\\'", "\\x"),
        spell_name: ("\\x", "\x1b"),
        shorten: ("\n", "\x1b"),
    }.items():
        for pattern in patterns:
            for ending in ("", "x", "\n"):
                name = f"{function.__name__} of {pattern!r} and {ending!r}"
                case(name, partial(function, pattern * count + ending))
    for pattern in (
        b"\n",
        b" ",
        b"//",
        b"1,",
        b" ,",
        b"\\\n",
        b"\\ ",
        b'"1',
        b"#",
        b"end_header\t",
        b"\nend_header ",
    ):
        for kind in ("xyz", "obj", "off", "ply"):
            file = folder / f"a.{kind}"
            file.write_bytes((b"ply\n" if kind == "ply" else b"") + pattern * count)
            case(f"{kind} of {pattern!r}", partial(meshes.read, file))


if __name__ == "__main__":
    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_AS, (2**33, 2**33))
    with TemporaryDirectory() as place:
        {"parameters": stored_parameters, "fields": stored_fields, "files": files, "texts": texts}[
            sys.argv[1]
        ](Path(place))
