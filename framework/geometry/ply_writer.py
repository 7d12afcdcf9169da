"""Writer of binary PLY files: triangles and vertices, which may have colours."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from framework.geometry.mesh_files import COLOURS


def write_ply(
    file: Path,
    vertices: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    colors: UInt8[np.ndarray, "vertices 3"] | None = None,
) -> None:
    """Write a mesh as a binary PLY file; without faces it is a point cloud."""
    columns = [("place", "<f4", 3), *([] if colors is None else [("colour", "u1", 3)])]
    table = np.empty(len(vertices), columns)
    table["place"] = vertices
    if colors is not None:
        table["colour"] = colors
    rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in COLOURS if colors is not None),
        f"element face {len(rows)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes("\n".join(head).encode("ascii") + table.tobytes() + rows.tobytes())
