"""Rows of the contract: a large and a small grid, several truncations."""

from framework.testing.rows import CloudRow

ROWS = {
    "tdf": (
        CloudRow("defaults", (40, 3)),
        CloudRow("within the cell", (40, 3), config={"side": 8, "truncation": 0.5}),
        CloudRow(
            "small grid, wide",
            (40, 6),
            config={"side": 4, "truncation": 2.5, "normalise": "robust"},
        ),
        CloudRow("one cell, one point", (1, 3), config={"side": 1}),
    )
}
