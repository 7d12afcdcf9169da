"""Rows of the contract: a large and a small grid, several truncations."""

from framework.testing.rows import EncoderRow

ROWS = {
    "tdf": (
        EncoderRow("defaults", (40, 3)),
        EncoderRow("within the cell", (40, 3), config={"side": 8, "truncation": 0.5}),
        EncoderRow(
            "small grid, wide",
            (40, 6),
            config={"side": 4, "truncation": 2.5, "normalise": "robust"},
        ),
        EncoderRow("one cell, one point", (1, 3), config={"side": 1}),
    )
}
