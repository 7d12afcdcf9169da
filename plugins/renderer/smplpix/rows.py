"""Rows of the contract: one level and several, sizes that are even and not."""

from framework.testing.rows import CloudRow

NEAR = {"nearest": 0.1, "farthest": 20.0}
ROWS = {
    "projection": (
        CloudRow("the thesis's size", (40, 6), config=NEAR),
        CloudRow("four levels", (300, 8), config={**NEAR, "height": 21, "width": 34, "levels": 4}),
        CloudRow(
            "named columns, one pixel",
            (40, 7),
            columns=("x", "y", "z", "red", "green", "blue", "part"),
            config={**NEAR, "height": 1, "width": 1, "levels": 2},
        ),
        CloudRow("one point", (1, 6), config={**NEAR, "height": 12, "width": 9}),
    )
}
