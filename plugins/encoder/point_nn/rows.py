"""Contract-test cases: all or half of the points of a cloud, and more stages than the cloud has points."""

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
