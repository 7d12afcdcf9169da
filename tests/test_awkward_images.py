"""Awkward images, as cameras, editors and other programs write them, through every reader of images.

Each shows the same four squares. All readers find the colours that the file says, or all refuse it with a sentence.
"""

import base64
import io
import re
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image, ImageCms

import framework
import plugins
from framework.configuration import registry
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.datasets import images, scan_layout
from framework.deployment.served import ServedModel
from framework.errors import DataError
from framework.geometry.srgb import bytes_from_linear
from framework.scenes import scene_files
from framework.testing.sample_scenes import OBJ, PARTS, QUAD, glb
from plugins.data.human_scans import skins

SIDE = 32
COLOURS = np.array([[255, 0, 0], [0, 200, 100], [40, 80, 250], [10, 30, 90]])
"""Colours of the squares, row by row; the last square is transparent in images with transparency."""
GREYS = np.array([0, 85, 170, 255])
WHITE = (255, 255, 255)


@dataclass(frozen=True)
class Case:
    """A file and what it shows.

    Attributes:
        content: of the file.
        seen: colours of the squares over white; None: it is refused.
        below: the same without transparency.
        turned: the same as `seen` where the EXIF entry is followed.
        off: how far a colour may be off: of JPEG, and where 16 bits become 8.
        suffix: of the file's name.
    """

    content: bytes
    seen: np.ndarray | None
    below: np.ndarray | None = None
    turned: np.ndarray | None = None
    off: int = 0
    suffix: str = ".png"


def squares(values: np.ndarray) -> np.ndarray:
    """Return an image of four squares, (side, side, channels)."""
    values = np.asarray(values)
    return values.reshape(2, 2, -1).repeat(SIDE // 2, 0).repeat(SIDE // 2, 1)


def saved(image: Image.Image, form: str, **options: Any) -> bytes:
    content = io.BytesIO()
    image.copy().save(content, form, **options)  # saving as JPEG leaves settings behind
    return content.getvalue()


def image(values: np.ndarray, mode: str = "RGB") -> Image.Image:
    pixels = squares(values).astype(np.uint8)
    return Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels).convert(mode)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(values: np.ndarray, bits: int, kind: int, *chunks: bytes, interlaced: bool = False) -> bytes:
    """Return a PNG file (ISO/IEC 15948) with a bit depth that Pillow does not write."""
    pixels = squares(values)
    passes = [(0, 0, 1, 1)]
    if interlaced:  # section 8.2, Adam7: first row and column, and the steps
        passes = [
            (0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1)
        ]  # fmt: skip
    rows = b""
    for row, column, down, right in passes:
        for line in pixels[row::down, column::right].reshape(len(pixels[row::down]), -1):
            if bits == 16:
                rows += b"\0" + line.astype(">u2").tobytes()
            else:
                binary = (line[:, None] >> np.arange(bits)[::-1]) & 1
                rows += b"\0" + np.packbits(binary.astype(np.uint8)).tobytes()
    head = struct.pack(">IIBBBBB", SIDE, SIDE, bits, kind, 0, 0, int(interlaced))
    data = chunk(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + b"".join(chunks) + data + chunk(b"IEND", b"")


def key(*values: int) -> bytes:
    """Return the PNG chunk that marks one colour as transparent."""
    return chunk(b"tRNS", struct.pack(f">{len(values)}H", *values))


def grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(np.asarray(values)[:, None], 3, 1)


def frames() -> dict[str, Any]:
    """Return options with which Pillow saves a second, black image in the same file."""
    return {"save_all": True, "append_images": [Image.new("RGB", (SIDE, SIDE))]}


def exif(turn: int) -> bytes:
    entries = Image.Exif()
    entries[0x0112] = turn
    return entries.tobytes()


GREY_AND_ALPHA = np.stack([GREYS, [255, 255, 255, 0]], 1)
WITH_ALPHA = np.concatenate([COLOURS, [[255], [255], [255], [0]]], 1)
OVER_WHITE = np.concatenate([COLOURS[:3], [WHITE]])
FINE = np.array([0, 1000, 40000, 65535])
PALETTE = chunk(b"PLTE", COLOURS.astype(np.uint8).tobytes())
ORDER = np.arange(4)[:, None]


def tiff(values: np.ndarray, kind: type, tags: Mapping[int, int] | None = None) -> bytes:
    whole = Image.fromarray(squares(values)[..., 0].astype(kind))
    return saved(whole, "TIFF", tiffinfo=dict(tags or {}))


def transparent(colour: int | tuple[int, ...]) -> np.ndarray:
    """Return greys composed over white, with one transparent level."""
    return grey(np.where(colour == GREYS, 255, GREYS))


def cases() -> dict[str, Case]:
    found: dict[str, Case] = {}
    rgb, white_last = image(COLOURS), OVER_WHITE
    with_alpha = image(WITH_ALPHA, "RGBA")

    found["8 bit colour"] = Case(saved(rgb, "PNG"), COLOURS)
    found["16 bit grey"] = Case(png(FINE, 16, 0), grey(np.round(FINE / 257)), off=1)
    found["16 bit colour"] = Case(png(257 * COLOURS, 16, 2), COLOURS)
    found["16 bit colour and alpha"] = Case(png(257 * WITH_ALPHA, 16, 6), white_last, COLOURS)
    found["16 bit grey and alpha"] = Case(png(257 * GREY_AND_ALPHA, 16, 4), grey([0, 85, 170, 255]))
    for bits in (1, 2, 4, 8, 16):
        most = 2**bits - 1
        values = np.round(GREYS / 255) * most if bits == 1 else GREYS * most // 255
        shown = np.round(GREYS / 255) * 255 if bits == 1 else GREYS
        found[f"{bits} bit grey"] = Case(png(values.astype(np.int64), bits, 0), grey(shown))
        seen = np.where(values == values[1], 255, shown)
        found[f"{bits} bit grey, one of it transparent"] = Case(
            png(values.astype(np.int64), bits, 0, key(int(values[1]))), grey(seen), grey(shown)
        )
    last = tuple(COLOURS[3].tolist())
    found["8 bit colour, one of it transparent"] = Case(png(COLOURS, 8, 2, key(*last)), white_last, COLOURS)
    found["16 bit colour, one of it transparent"] = Case(
        png(257 * COLOURS, 16, 2, key(*(257 * number for number in last))), None
    )
    for bits in (2, 4, 8):
        found[f"palette of {bits} bits"] = Case(png(ORDER, bits, 3, PALETTE), COLOURS)
    shares = chunk(b"tRNS", bytes([255, 255, 255, 0]))
    found["palette with alpha"] = Case(png(ORDER, 8, 3, PALETTE, shares), white_last, COLOURS)
    for bits, kind, values in (
        (8, 2, COLOURS),
        (16, 0, 257 * GREYS),
        (1, 0, GREYS // 128),
        (8, 6, WITH_ALPHA),
    ):
        whole = found[{(8, 2): "8 bit colour", (16, 0): "16 bit grey and alpha", (1, 0): "1 bit grey"}.get(
            (bits, kind), "16 bit colour and alpha")]  # fmt: skip
        content = png(values, bits, kind, interlaced=True)
        found[f"interlaced, {bits} bits, kind {kind}"] = Case(content, whole.seen, whole.below)
    found["grey and alpha"] = Case(saved(image(GREY_AND_ALPHA, "LA"), "PNG"), grey(GREYS))
    found["colour and alpha"] = Case(saved(with_alpha, "PNG"), white_last, COLOURS)
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    found["a profile of colours"] = Case(saved(rgb, "PNG", icc_profile=profile), COLOURS)
    turned = COLOURS[[2, 0, 3, 1]]  # of orientation 6: a quarter clockwise
    found["turned PNG"] = Case(saved(rgb, "PNG", exif=exif(6)), COLOURS, turned=turned)
    found["mirrored JPEG"] = Case(
        saved(rgb, "JPEG", quality=100, subsampling=0, exif=exif(5)),
        COLOURS,
        None,
        COLOURS[[0, 2, 1, 3]],
        3,
        ".jpg",
    )
    found["moving PNG"] = Case(saved(rgb, "PNG", **frames()), COLOURS)
    palette = rgb.quantize(4, dither=Image.Dither.NONE)
    found["moving GIF"] = Case(saved(palette, "GIF", **frames()), COLOURS, suffix=".gif")
    found["transparent GIF"] = Case(
        saved(palette, "GIF", transparency=palette.getpixel((SIDE - 1, SIDE - 1))),
        white_last,
        COLOURS,
        suffix=".gif",
    )
    jpeg = {"quality": 100, "subsampling": 0}
    found["progressive JPEG"] = Case(
        saved(rgb, "JPEG", progressive=True, **jpeg), COLOURS, off=3, suffix=".JPEG"
    )
    found["JPEG of CMYK"] = Case(saved(rgb.convert("CMYK"), "JPEG", **jpeg), COLOURS, off=6, suffix=".JPG")
    found["grey JPEG"] = Case(saved(image(GREYS, "L"), "JPEG", **jpeg), grey(GREYS), off=2, suffix=".Jpg")
    found["JPEG of several images"] = Case(
        saved(rgb, "MPO", **frames(), **jpeg), COLOURS, off=3, suffix=".jpg"
    )
    found["JPEG called PNG"] = Case(saved(rgb, "JPEG", **jpeg), COLOURS, off=3)
    found["PNG called JPEG"] = Case(saved(with_alpha, "PNG"), white_last, COLOURS, suffix=".JPG")
    found["WebP"] = Case(
        saved(with_alpha, "WEBP", lossless=True, exact=True), white_last, COLOURS, suffix=".webp"
    )
    found["JPEG 2000 of 16 bits"] = Case(
        saved(Image.fromarray(squares(FINE)[..., 0].astype(np.uint16)), "JPEG2000"),
        grey(np.round(FINE / 257)), suffix=".jp2",
    )  # fmt: skip
    found["BMP of 1 bit"] = Case(
        saved(image(GREYS // 128 * 255, "1"), "BMP"), grey(GREYS // 128 * 255), suffix=".BMP"
    )
    found["TGA"] = Case(saved(with_alpha, "TGA"), white_last, COLOURS, suffix=".tga")
    found["ICO"] = Case(saved(with_alpha, "ICO", sizes=[(SIDE, SIDE)]), white_last, COLOURS, suffix=".ico")
    plain = squares(257 * GREYS)[..., 0].astype(">u2")
    found["PGM of 16 bits"] = Case(b"P5 32 32 65535\n" + plain.tobytes(), grey(GREYS), suffix=".pgm")
    found["PGM of 12 bits"] = Case(
        b"P5 32 32 4095\n" + (plain // 16).astype(">u2").tobytes(), grey(GREYS), suffix=".pgm"
    )
    floats = squares(GREYS / 255)[..., 0].astype("<f4")
    found["PFM"] = Case(b"Pf\n32 32\n-1.0\n" + floats.tobytes(), None, suffix=".pfm")
    found["TIFF"] = Case(
        saved(with_alpha, "TIFF", compression="tiff_lzw"), white_last, COLOURS, suffix=".TIF"
    )
    found["TIFF of pages"] = Case(saved(rgb, "TIFF", **frames()), COLOURS, suffix=".tiff")
    found["TIFF of CMYK"] = Case(saved(rgb.convert("CMYK"), "TIFF"), COLOURS, off=1, suffix=".tif")
    found["TIFF of 16 bits"] = Case(tiff(FINE, np.uint16), grey(np.round(FINE / 257)), suffix=".tif")
    found["TIFF of 16 bits, 0 is white"] = Case(
        tiff(FINE, np.uint16, {262: 0}), grey(255 - np.round(FINE / 257)), suffix=".tif"
    )
    found["TIFF of 32 bits"] = Case(tiff(1000 * FINE, np.int32), None, suffix=".tif")
    found["TIFF of floats"] = Case(tiff(GREYS / 255, np.float32), None, suffix=".tif")
    found["nothing"] = Case(b"", None)
    found["text"] = Case(b"<!DOCTYPE html><html>404 Not Found</html>", None, suffix=".jpg")
    found["cut short"] = Case(saved(rgb, "PNG")[:-40], None)
    for what, width in (("of no pixels", 0), ("of too many pixels", 2**17)):
        head = struct.pack(">IIBBBBB", width, 2**10, 8, 2, 0, 0, 0)
        found[what] = Case(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IEND", b""), None)
    return found


CASES = cases()
Reader = Callable[[Case, Path], np.ndarray]


def written(case: Case, folder: Path, name: str = "") -> Path:
    file = folder / (name or f"Image 1{case.suffix}")
    file.write_bytes(case.content)
    return file


def image_data(sound: Path) -> Iterator[tuple[str, Data]]:
    """Yield every installed data set of photographs."""
    for name in registry.installed("data"):
        if registry.load("data", name).suffixes == images.SUFFIXES:
            data: Data = build("data", resolve("data", {"name": name}))
            data.input_shape = tuple(data.read([sound])[0]["input"].shape)
            yield name, data


def pixels(inputs: torch.Tensor) -> np.ndarray:
    """Return an image (channels, height, width) as 8-bit numbers."""
    assert inputs.dtype == torch.uint8
    return inputs.movedim(0, -1).numpy()


def texture(file: Path) -> np.ndarray:
    found = scene_files.read(file)
    assert found.scene.texture is not None, found.notes
    return bytes_from_linear(found.scene.texture.images[0]).numpy()


def of_gltf(case: Case, folder: Path) -> np.ndarray:
    return texture(written(Case(glb(QUAD, [*PARTS, case.content]), None), folder, "one.glb"))


def of_obj(case: Case, folder: Path) -> np.ndarray:
    name = written(case, folder).name
    (folder / "one.mtl").write_text(f"newmtl red\nmap_Kd {name}\n")
    (folder / "one.obj").write_bytes(OBJ)
    return texture(folder / "one.obj")


def of_ply(case: Case, folder: Path) -> np.ndarray:
    name = written(case, folder).name
    rows = "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
    columns = "".join(f"property float {column}\n" for column in "xyzst")
    head = f"ply\nformat ascii 1.0\ncomment TextureFile {name}\nelement vertex 3\n{columns}"
    (folder / "one.ply").write_text(
        f"{head}element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}"
    )
    return texture(folder / "one.ply")


def of_photograph(case: Case, folder: Path) -> np.ndarray:
    camera = scan_layout.Camera(torch.eye(3), torch.zeros(3), (1.0, 1.0), (0.0, 0.0), SIDE, SIDE)
    mask = folder / "mask.png"
    Image.new("L", (SIDE, SIDE)).save(mask)
    return scan_layout.read_photograph(scan_layout.View("one", written(case, folder), mask, camera)).pixels


def of_subject(case: Case, folder: Path) -> np.ndarray:
    (folder / "subjects" / "ann").mkdir(parents=True)
    written(case, folder / "subjects" / "ann", "texture.png")
    return scan_layout.read_texture(folder, "ann")


STORED: dict[str, Reader] = {
    "photograph of a scan": of_photograph,
    "texture of a subject": of_subject,
    "skin": lambda case, folder: skins.read(written(case, folder)),
}
"""Readers of the stored pixels, composed over white."""
TEXTURES: dict[str, Reader] = {"glTF": of_gltf, "OBJ": of_obj, "PLY": of_ply}
"""Readers of the colours below transparent pixels."""


def upright(data: Data) -> dict[str, Reader]:
    """Readers of a data set of photographs, which rotate images as their EXIF orientation requires."""

    def of_request(case: Case, folder: Path) -> np.ndarray:
        sent = {"base64": [base64.b64encode(case.content).decode()], "name": [f"image{case.suffix}"]}
        served = object.__new__(ServedModel)  # as far as requests are read: that needs no trained model
        vars(served).update(predictor=torch.nn.Identity(), data=data)
        return pixels(served._read_request(pd.DataFrame(sent))["input"][0])

    def of_notebook(case: Case, folder: Path) -> np.ndarray:
        try:
            whole = Image.open(io.BytesIO(case.content))
        except Exception:
            pytest.skip("Pillow itself refuses it")
        with whole:
            return pixels(data.inputs(whole)[0])

    return {
        "file": lambda case, folder: pixels(data.read([written(case, folder)])[0]["input"]),
        "request": of_request,
        "notebook": of_notebook,
    }


@pytest.fixture(scope="module")
def data_sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Data]:
    sound = tmp_path_factory.mktemp("sound") / "sound.png"
    image(WITH_ALPHA, "RGBA").resize((SIDE, SIDE)).save(sound)
    return dict(image_data(sound))


def require_squares(found: np.ndarray, wanted: np.ndarray, off: int, reader: str) -> None:
    """Compare the middles of the squares; readers scale images and some of them read grey."""
    down, across = found.shape[0] // 4, found.shape[1] // 4
    middles = found[down :: 2 * down, across :: 2 * across][:2, :2].reshape(4, -1)
    if middles.shape[1] == 1:
        wanted = wanted @ np.array([[0.299], [0.587], [0.114]])  # ITU-R BT.601
    np.testing.assert_allclose(middles, wanted, atol=off + 0.75, err_msg=reader)


@pytest.mark.parametrize("name", CASES)
def test_every_reader_finds_the_colours_or_refuses_with_a_sentence(
    name: str, data_sets: dict[str, Data], tmp_path: Path
) -> None:
    case = CASES[name]
    below = case.seen if case.below is None else case.below
    turned = case.seen if case.turned is None else case.turned
    readers: list[tuple[str, Reader, np.ndarray | None]] = []
    for what, data in data_sets.items():
        readers += [(f"{what}, {way}", reader, turned) for way, reader in upright(data).items()]
    readers += [(what, reader, case.seen) for what, reader in STORED.items()]
    readers += [(what, reader, below) for what, reader in TEXTURES.items()]
    for number, (what, reader, wanted) in enumerate(readers):
        folder = tmp_path / str(number)
        folder.mkdir()
        if wanted is None:
            with pytest.raises(DataError, match=REFUSED):
                reader(case, folder)
        else:
            require_squares(reader(case, folder), wanted, case.off, what)


REFUSED = re.compile(r"^(?!.*[<>]).*(Image 1\.|one\.|texture|row 0|An image of mode).*\. ?[A-Z]", re.DOTALL)
"""Require that the message names the file and tells the user what to do."""


@pytest.mark.parametrize(
    "name", [name for name, case in CASES.items() if case.below is not None or case.seen is None]
)
def test_a_body_cut_out_of_its_ground_is_read_from_every_image_with_alpha(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    options = {"name": "pose_from_image", "height": SIDE, "width": SIDE}
    data: Data = build("data", resolve("data", options))
    if case.seen is None:
        with pytest.raises(DataError, match=REFUSED):
            data.read([written(case, tmp_path)])
        return
    inputs = data.read([written(case, tmp_path)])[0]["input"]
    shown = bytes_from_linear(inputs[:3] + (1 - inputs[3:])).movedim(0, -1).numpy()
    require_squares(shown, case.seen, case.off, name)


def test_no_module_but_one_decodes_images() -> None:
    decoders = r"\bImage\.open\(|\bimread\(|\bdecode_(?:image|png|jpeg)\(|\bread_image\("
    sources = [file for room in (framework, plugins) for file in Path(room.__path__[0]).rglob("*.py")]
    found = [
        file
        for file in sources
        if not file.name.startswith("test_") and re.search(decoders, file.read_text())
    ]
    assert [file.name for file in found] == ["images.py"]
