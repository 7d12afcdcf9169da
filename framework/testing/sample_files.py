"""Small image and mesh files such as a user may have, for contract rows of data sets."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from framework.testing.finding import SEED


def damaged_copies(content: bytes, count: int) -> Iterator[bytes]:
    """Yield `count` copies of the bytes of a file, in each of which up to three bytes are replaced at random."""
    random = np.random.default_rng(0)
    for _ in range(count):
        damaged = np.frombuffer(content, np.uint8).copy()
        positions = random.integers(0, len(content), 3)
        damaged[positions] = random.integers(0, 256, 3)
        yield damaged.tobytes()


def noise_image(file: Path, number: int, size: tuple[int, int] = (20, 20)) -> Path:
    """Write a colour image of random pixels and return its path.

    Args:
        file: Path of the image; its suffix determines the format.
        number: Number that selects the seed of the pixels.
        size: Height and width, pixels.
    """
    pixels = np.random.default_rng([SEED, number]).integers(0, 256, (*size, 3), np.uint8)
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file)
    return file


def images(folder: Path) -> Sequence[Path]:
    """Write a wide and a tall image in two formats, and return their paths."""
    wide, tall = folder / "wide.png", folder / "tall.jpg"
    return noise_image(wide, 0, (30, 40)), noise_image(tall, 1, (50, 20))


def surface(number: int, side: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (side², 3) and triangles (face, 3) of a rough surface away from the origin.

    `number` selects the seed of the surface, and `side` is the number of vertices along one side.
    """
    random = np.random.default_rng([SEED, number])
    row, column = np.divmod(np.arange(side**2), side)
    vertices = np.stack([row, column, random.normal(size=side**2)], -1) + random.normal(3, 1, 3)
    corner = np.flatnonzero((row < side - 1) & (column < side - 1))
    halves = [(0, side, 1), (side, side + 1, 1)]
    return vertices.round(4), np.concatenate([corner[:, None] + half for half in halves])


def write_off(file: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """Write a mesh in the Object File Format, and return its path."""
    return _write(file, ["OFF", f"{len(vertices)} {len(faces)} 0"], vertices, faces)


def write_ply(file: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    """Write a mesh as ASCII PLY, and return its path."""
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return _write(file, head, vertices, faces)


def _write(file: Path, head: Sequence[str], vertices: np.ndarray, faces: np.ndarray) -> Path:
    rows = [" ".join(map(str, row)) for row in vertices.tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join([*head, *rows, ""]), encoding="ascii")
    return file


def meshes(folder: Path) -> Sequence[Path]:
    """Write two rough surfaces in two formats, and return their paths."""
    first, second = surface(0), surface(1, side=7)
    return write_ply(folder / "first.ply", *first), write_off(folder / "second.off", *second)
