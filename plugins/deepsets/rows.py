"""Rows of the contract: both activations, with and without attributes."""

from framework.testing.rows import EncoderRow

SMALL = {"channels": [12, 12], "widths": [8]}
COLOURED = ("x", "y", "z", "red", "green", "blue")

ROWS = {
    "deepsets": (
        EncoderRow("tanh", (40, 3), config=SMALL),
        EncoderRow("elu", (40, 3), config={**SMALL, "activation": "elu"}),
        EncoderRow(
            "attributes", (30, 6), {**SMALL, "attributes": True, "normalise": "robust"}, columns=COLOURED
        ),
        EncoderRow("the first points", (30, 3), config={**SMALL, "points": 10, "normalise": "none"}),
    )
}
