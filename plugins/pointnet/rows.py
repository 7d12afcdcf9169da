"""Rows of the contract: both variants, with and without attributes."""

from framework.testing.rows import EncoderRow

SMALL = {"point_widths": [8, 8, 8, 12], "widths": [12, 8]}
COLOURED = ("x", "y", "z", "red", "green", "blue")

ROWS = {
    "pointnet": (
        EncoderRow("vanilla", (40, 3), config={**SMALL, "variant": "vanilla"}),
        EncoderRow("full", (40, 3), config=SMALL),
        EncoderRow(
            "attributes", (30, 6), {**SMALL, "attributes": True, "normalise": "robust"}, columns=COLOURED
        ),
        EncoderRow("the first points", (30, 3), config={**SMALL, "points": 10, "normalise": "none"}),
    )
}
