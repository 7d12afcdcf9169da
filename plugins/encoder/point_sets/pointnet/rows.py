"""Rows of the contract: both variants, with and without attributes."""

from framework.testing.rows import CloudRow

SMALL = {"point_widths": [8, 8, 8, 12], "widths": [12, 8]}
COLOURED = ("x", "y", "z", "red", "green", "blue")

ROWS = {
    "pointnet": (
        CloudRow("vanilla", (40, 3), config={**SMALL, "variant": "vanilla"}),
        CloudRow("full", (40, 3), config=SMALL),
        CloudRow(
            "attributes", (30, 6), {**SMALL, "attributes": True, "normalise": "robust"}, columns=COLOURED
        ),
        CloudRow(
            "the first points",
            (30, 3),
            config={**SMALL, "points": 10, "normalise": "none"},
            leave_out={"points in any order": "the first points are read alone"},
        ),
    )
}
