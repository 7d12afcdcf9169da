"""Contract-test cases: one level and several, sizes even and odd, with splats and without."""

from typing import Any

from framework.testing.rows import CloudRow

NEAR: dict[str, Any] = {"nearest": 0.1, "farthest": 20.0}
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
        CloudRow(
            "splats, two levels", (40, 6), config={**NEAR, "height": 21, "width": 16, "levels": 2, "splat": 4}
        ),
    ),
}
