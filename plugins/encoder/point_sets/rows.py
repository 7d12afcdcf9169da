"""Rows of the contract: each variant and activation, with and without attributes."""

from framework.testing.rows import CloudRow

COLOURED = ("x", "y", "z", "red", "green", "blue")


def rows(first: CloudRow, second: CloudRow) -> tuple[CloudRow, ...]:
    """Two rows, and the second's network on attributes and on the first points alone."""
    small = second.config
    return (
        first,
        second,
        CloudRow(
            "attributes", (30, 6), {**small, "attributes": True, "normalise": "robust"}, columns=COLOURED
        ),
        CloudRow(
            "the first points",
            (30, 3),
            config={**small, "points": 10, "normalise": "none"},
            leave_out={"points in any order": "the first points are read alone"},
        ),
    )


NET = {"point_widths": [8, 8, 8, 12], "widths": [12, 8]}
SETS = {"channels": [12, 12], "widths": [8]}
ROWS = {
    "pointnet": rows(
        CloudRow("vanilla", (40, 3), config={**NET, "variant": "vanilla"}),
        CloudRow("full", (40, 3), config=NET),
    ),
    "deepsets": rows(
        CloudRow("elu", (40, 3), config={**SETS, "activation": "elu"}), CloudRow("tanh", (40, 3), config=SETS)
    ),
}
