"""Rows of the contract: both activations, with and without attributes."""

from framework.testing.rows import CloudRow

SMALL = {"channels": [12, 12], "widths": [8]}
COLOURED = ("x", "y", "z", "red", "green", "blue")

ROWS = {
    "deepsets": (
        CloudRow("tanh", (40, 3), config=SMALL),
        CloudRow("elu", (40, 3), config={**SMALL, "activation": "elu"}),
        CloudRow(
            "attributes", (30, 6), {**SMALL, "attributes": True, "normalise": "robust"}, columns=COLOURED
        ),
        CloudRow(
            "the first points",
            (30, 3),
            config={**SMALL, "points": 10, "normalise": "none"},
            leave_out={"points in any order": "the first points are read alone"},
        ),
    )
}
