"""Finds FAUST's training scans and reads their registrations."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.errors import DataError
from framework.geometry.meshes import read

SUBJECTS, POSES = 10, 10
WANTED = (
    "Wanted: the folder that holds training/scans/tr_scan_000.ply and training/registrations/tr_reg_000.ply to "
    "tr_scan_099.ply and tr_reg_099.ply."
)


@dataclass(frozen=True)
class Scan:
    """One training scan, 0 to 99: person number // 10 in pose number % 10."""

    number: int
    scan: Path
    registration: Path

    @property
    def subject(self) -> int:
        return self.number // POSES


def scans(root: str | None) -> tuple[Path, list[Scan]]:
    """The folder and every training scan in it that is there, with its registration.

    Raises:
        DataError: no root, no such layout in it, or one of a pair missing.
    """
    if root is None:
        raise DataError(
            "data.root is not set: FAUST is licensed by the Max Planck Society and neither shipped nor generated. "
            + WANTED
        )
    folder = Path(root).expanduser()
    found = []
    for number in range(SUBJECTS * POSES):
        pair = Scan(
            number,
            folder / "training" / "scans" / f"tr_scan_{number:03}.ply",
            folder / "training" / "registrations" / f"tr_reg_{number:03}.ply",
        )
        there = pair.scan.is_file(), pair.registration.is_file()
        if any(there) and not all(there):
            missing = pair.registration if there[0] else pair.scan
            raise DataError(f"{missing} is not available, but the other of its pair is. {WANTED}")
        if all(there):
            found.append(pair)
    if not found:
        raise DataError(f"data.root = {folder}: FAUST is not available there. {WANTED}")
    return folder, found


def registered(scan: Scan, vertices: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices, metres, and faces of a scan's registration.

    Raises:
        DataError: it cannot be read, or has another number of vertices than wanted.
    """
    mesh = read(scan.registration)
    if vertices not in (None, len(mesh.vertices)):
        raise DataError(
            f"{scan.registration}: {len(mesh.vertices)} vertices, the first registration has {vertices}; wanted one "
            "mesh throughout. Restore it from its source."
        )
    return mesh.vertices, mesh.faces
