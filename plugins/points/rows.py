"""Rows of the contract: fewer and more points than the cloud has, both choices."""

from framework.testing.rows import EncoderRow

ROWS = {
    "points": (
        EncoderRow("more than there are", (40, 3), config={"points": 100}),
        EncoderRow("random", (40, 3), config={"points": 16}),
        EncoderRow(
            "farthest, attributes",
            (40, 6),
            config={"points": 16, "choice": "farthest", "normalise": "robust"},
        ),
        EncoderRow("as they are", (40, 3), config={"points": 16, "normalise": "none"}),
        EncoderRow("one", (1, 3), config={"points": 1}),
    )
}
