"""Contract-test cases: fewer points than the cloud has, as many, and more, with both choices."""

from framework.testing.rows import CloudRow

BY_POSITION = {"points in any order": "points are chosen by their index in the cloud, and keep their order"}
ROWS = {
    "points": (
        CloudRow("more than there are", (40, 3), config={"points": 100}, leave_out=BY_POSITION),
        CloudRow("random", (40, 3), config={"points": 16}, leave_out=BY_POSITION),
        CloudRow(
            "farthest, attributes",
            (40, 6),
            config={"points": 16, "choice": "farthest", "normalise": "robust"},
        ),
        CloudRow("as they are", (40, 3), config={"points": 16, "normalise": "none"}, leave_out=BY_POSITION),
        CloudRow("one", (1, 3), config={"points": 1}),
    )
}
