"""Rows of the contract: fewer and more points than the cloud has, both choices."""

from framework.testing.rows import CloudRow

DRAWN = {"points in any order": "points are drawn by their place in the cloud, and keep their order"}
ROWS = {
    "points": (
        CloudRow("more than there are", (40, 3), config={"points": 100}, leave_out=DRAWN),
        CloudRow("random", (40, 3), config={"points": 16}, leave_out=DRAWN),
        CloudRow(
            "farthest, attributes",
            (40, 6),
            config={"points": 16, "choice": "farthest", "normalise": "robust"},
        ),
        CloudRow("as they are", (40, 3), config={"points": 16, "normalise": "none"}, leave_out=DRAWN),
        CloudRow("one", (1, 3), config={"points": 1}),
    )
}
