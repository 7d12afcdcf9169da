"""Contract-test cases: photographs of a dressed doll, and a folder of six people."""

from collections.abc import Sequence
from pathlib import Path

from framework.datasets import scan_layout
from framework.testing.bodies import DOLL, colored_mesh, write_body_file, write_subjects
from framework.testing.rows import DAMAGES, DataRow


def colored_meshes(folder: Path) -> Sequence[Path]:
    """Write two meshes with vertex colours, and return their paths."""
    files = [folder / "one.ply", folder / "other.ply"]
    for number, file in enumerate(files):
        scan_layout.write_registration(file, colored_mesh(number))
    return files


SMALL = {"renderer": "rasterizer", "topologies": ["7k"], "views": 2}
ROWS = {
    "human_scans": (
        DataRow(
            "a dressed doll",
            {**SMALL, "train": 3, "validation": 1, "test": 2, "height": 24, "width": 18, "texture_side": 0},
            write=write_body_file,
            synthetic=True,
            files=colored_meshes,
            fragile={"doll.npz": DAMAGES},
            changes={"data_seed": 1, "test": 3, "views": 3, "width": 20},
        ),
        DataRow(
            "six people",
            {**SMALL, **DOLL, "train": 1, "validation": 1, "test": 1, "height": 12, "width": 9},
            write=write_subjects,
            synthetic=False,
            files=colored_meshes,
            fragile={
                "test.txt": ("missing", "empty", "folder", "garbage"),
                **{f"subjects/*/{name}": DAMAGES for name in ("registration_7k.ply", "cameras.json")},
                **{f"subjects/*/{name}/*.png": DAMAGES for name in ("images", "masks")},
            },
        ),
        DataRow(
            "six silhouettes",
            {
                **SMALL,
                **DOLL,
                "train": 1,
                "validation": 1,
                "test": 1,
                "height": 12,
                "width": 9,
                "shows": "subject",
            },
            write=write_subjects,
            synthetic=False,
            files=colored_meshes,
        ),
    ),
}
