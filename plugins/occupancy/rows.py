"""Rows of the contract: a large and a small grid."""

from framework.testing.rows import EncoderRow

ROWS = {
    "occupancy": (
        EncoderRow("defaults", (40, 3)),
        EncoderRow("small grid, attributes", (40, 6), config={"side": 4, "normalise": "robust"}),
        EncoderRow("one cell, one point", (1, 3), config={"side": 1}),
    )
}
