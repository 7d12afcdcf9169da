"""Contract-test cases: fewer, as many and more points than a cloud has."""

from framework.testing.rows import CloudRow

SMALL = {"width": 12, "stages": 2, "neighbours": 6, "frequency": 10.0}
ROWS = {
    "point_nn": (
        CloudRow("all points", (40, 3), config=SMALL),
        CloudRow(
            "half of the points, robust", (40, 6), config={**SMALL, "points": 20, "normalise": "robust"}
        ),
        CloudRow("more stages than points", (3, 3), config={**SMALL, "stages": 4}),
    )
}
