"""Rows of the contract: a large and a small grid."""

from framework.testing.rows import CloudRow

ROWS = {
    "occupancy": (
        CloudRow("defaults", (40, 3)),
        CloudRow("small grid, attributes", (40, 6), config={"side": 4, "normalise": "robust"}),
        CloudRow("one cell, one point", (1, 3), config={"side": 1}),
    )
}
