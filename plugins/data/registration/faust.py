"""FAUST's file layout: paths of scans and registrations, and the pairs of its challenges."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from framework.errors import DataError
from framework.geometry.meshes import read
from framework.storage.reading import read_bytes, translate_errors
from framework.storage.text import decode

SUBJECTS, POSES = 10, 10
Challenge = Literal["intra", "inter"]
CHALLENGES: tuple[Challenge, ...] = ("intra", "inter")
WANTED = (
    "Expected: a folder that holds training/scans/tr_scan_000.ply and training/registrations/tr_reg_000.ply to "
    "tr_scan_099.ply and tr_reg_099.ply."
)


@dataclass(frozen=True)
class Scan:
    """Training scan of FAUST.

    Attributes:
        number: number of the scan, 0 to 99; it shows the person number // 10 in the pose number % 10.
        scan: path of the scan.
        registration: path of the scan's registration.
    """

    number: int
    scan: Path
    registration: Path

    @property
    def subject(self) -> int:
        """Return the number of the person, 0 to 9."""
        return self.number // POSES


class Pair(NamedTuple):
    """Numbers of two test scans, between which a challenge asks for the correspondence."""

    first: int
    second: int

    def __str__(self) -> str:
        return f"{self.first:03}_{self.second:03}"


def training_scan(folder: Path, number: int) -> Path:
    """Return the path of training scan `number`, 0 to 99."""
    return folder / "training" / "scans" / f"tr_scan_{number:03}.ply"


def training_registration(folder: Path, number: int) -> Path:
    """Return the path of the registration of training scan `number`, 0 to 99."""
    return folder / "training" / "registrations" / f"tr_reg_{number:03}.ply"


def test_scan(folder: Path, number: int) -> Path:
    """Return the path of test scan `number`."""
    return folder / "test" / "scans" / f"test_scan_{number:03}.ply"


def test_registration(folder: Path, number: int) -> Path:
    """Return the path of the registration of test scan `number`.

    Only generated people have registrations of test scans; FAUST publishes none.
    """
    return folder / "test" / "registrations" / f"test_reg_{number:03}.ply"


def pairs_file(folder: Path, challenge: Challenge) -> Path:
    """Return the path of the list of pairs of a challenge."""
    return folder / "test" / "challenge_pairs" / f"{challenge}_challenge.txt"


def pairs(folder: Path, challenge: Challenge) -> list[Pair]:
    """Return the pairs of scans of a challenge: of one person ("intra") or of two ("inter").

    Raises:
        DataError: the list does not exist, a line is not a pair, or a scan of a pair does not exist.
    """
    file = pairs_file(folder, challenge)
    with translate_errors(file, "pairs of a challenge", "Expected: two test scans a line, such as 000_001."):
        lines = decode(read_bytes(file)).split()
    scan_pairs = []
    for number, line in enumerate(lines, 1):
        match = re.fullmatch(r"(\d{3})_(\d{3})", line)
        if match is None:
            raise DataError(
                f"{file}, pair {number}: got {line[:40]!r}; expected two test scans, such as 000_001."
            )
        pair = Pair(*map(int, match.groups()))
        for scan_number in pair:
            if not test_scan(folder, scan_number).is_file():
                raise DataError(
                    f"{file}, pair {number}: the file {test_scan(folder, scan_number)} does not exist. Copy it from "
                    "its source."
                )
        scan_pairs.append(pair)
    if not scan_pairs:
        raise DataError(
            f"{file}: the list contains no pair; expected two test scans in each line, such as 000_001."
        )
    return scan_pairs


def scans(folder: Path) -> list[Scan]:
    """Return every training scan that exists, with its registration.

    Raises:
        DataError: the folder has another layout, or a scan or a registration is missing.
    """
    complete = []
    for number in range(SUBJECTS * POSES):
        pair = Scan(number, training_scan(folder, number), training_registration(folder, number))
        exist = pair.scan.is_file(), pair.registration.is_file()
        if any(exist) and not all(exist):
            missing = pair.registration if exist[0] else pair.scan
            raise DataError(f"{missing} is missing, but the other file of the pair exists. {WANTED}")
        if all(exist):
            complete.append(pair)
    if not complete:
        raise DataError(f"data.root = {folder}: this folder does not hold FAUST. {WANTED}")
    return complete


def read_registration(scan: Scan, vertices: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices, metres, and the faces of a scan's registration.

    Raises:
        DataError: the file cannot be read, or does not have `vertices` vertices (None: any number).
    """
    mesh = read(scan.registration)
    if vertices not in (None, len(mesh.vertices)):
        raise DataError(
            f"{scan.registration}: the mesh has {len(mesh.vertices)} vertices, but the first registration has "
            f"{vertices}; expected the same mesh in all files. Copy the file again from its source."
        )
    return mesh.vertices, mesh.faces
