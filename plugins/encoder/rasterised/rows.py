"""Contract-test cases: rendered images of the small body model `framework.testing.bodies.doll`, and of people."""

from pathlib import Path

import torch

from framework.testing.bodies import DOLL, FOLDER, colored_mesh, write_subjects
from framework.testing.rows import EncoderRow


def inputs_of(count: int) -> torch.Tensor:
    """Return inputs of `count` subjects, cycling through six people, 3 m in front of the camera."""
    people = [colored_mesh(number % 6) for number in range(count)]
    clouds = [
        torch.cat([mesh.vertices * 2 + torch.tensor([0, -2, 3]), mesh.colors / 255], 1) for mesh in people
    ]
    return torch.stack(clouds) if clouds else torch.empty(0, 40, 6)


SCANNED = write_subjects(Path(FOLDER.name) / "scans")
ROWS = {
    "rasterised": (
        EncoderRow("a doll", (132, 6), {**DOLL, "renderer": "rasterizer", "height": 16, "width": 12}),
        EncoderRow(
            "a doll, its depth",
            (132, 6),
            {**DOLL, "renderer": "rasterizer", "height": 9, "width": 14, "depth": True},
        ),
        EncoderRow(
            "six people's textures",
            (40, 6),
            {
                **SCANNED,
                "renderer": "rasterizer",
                "height": 24,
                "width": 18,
                "textures": {"name": "human_scans", **SCANNED},
            },
            leave_out={
                "finite on extreme inputs": "no subject has constant colours; test_textures.py checks other extremes"
            },
            inputs=inputs_of,
        ),
        EncoderRow(
            "a doll, its silhouette",
            (132, 6),
            {**DOLL, "renderer": "rasterizer", "height": 9, "width": 14, "ground": True},
        ),
    ),
}
