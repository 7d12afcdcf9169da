"""Contract-test cases: scans of a doll, and a few people in FAUST's layout."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from framework.testing.bodies import DOLL, person, write_body_file
from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import meshes, write_ply


def people(folder: Path) -> Mapping[str, str]:
    """Write two scans of each of four people in FAUST's layout, and return the settings that name their folder."""
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    for number in (0, 3, 70, 75, 80, 81, 90, 99):
        mesh, scan = person(number)
        write_ply(folder / f"training/registrations/tr_reg_{number:03}.ply", mesh, faces)
        write_ply(folder / f"training/scans/tr_scan_{number:03}.ply", scan, faces[:1])
    return {"root": str(folder)}


ROWS = {
    "registration": (
        DataRow(
            "a doll",
            {"train": 12, "validation": 4, "test": 9, "points": 200},
            write=write_body_file,
            synthetic=True,
            files=meshes,
            fragile={"doll.npz": DAMAGES},
            changes={"data_seed": 1, "test": 10, "shape_spread": 2.0},
        ),
    ),
    "faust": (
        DataRow(
            "four people",
            {"points": 200, **DOLL},
            write=people,
            synthetic=False,
            files=meshes,
            fragile={"training/scans/*.ply": DAMAGES, "training/registrations/*.ply": DAMAGES},
            changes={"data_seed": 1, "test": [8]},
        ),
    ),
}
