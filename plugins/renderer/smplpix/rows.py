"""Rows of the contract: one level and several, sizes even and odd, every normalisation, with and without crop."""

from framework.testing.rows import CloudRow, EncoderRow

NEAR = {"nearest": 0.1, "farthest": 20.0}
UNET = {"width": 6, "levels": 3}
SLIM = {"widths": [8, 12, 16]}
LESS_PRECISE = {"rows of a batch apart": 1e-2}  # as far as two bfloat16 are apart
AT_FIRST = {"gradients reach every parameter": "the last layer's weights are 0 until the first step"}
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
    ),
    "unet": (
        EncoderRow("odd size", (4, 13, 10), UNET),
        EncoderRow(
            "batch norm, scales, whole frame",
            (3, 8, 9),
            {**UNET, "normalisation": "batch", "scales": 3, "crop": None},
        ),
        EncoderRow("over its input", (5, 10, 9), {**UNET, "residual": True, "scales": 1}, leave_out=AT_FIRST),
        EncoderRow("group norm", (4, 9, 8), {**UNET, "normalisation": "group", "crop": None}),
    ),
    "slim": (
        EncoderRow("odd size", (4, 13, 10), SLIM),
        EncoderRow("over its input", (3, 11, 6), {**SLIM, "residual": True}, leave_out=AT_FIRST),
        EncoderRow("a scale, squares of 4", (3, 17, 20), {**SLIM, "unshuffle": 4, "scales": 1}),
        EncoderRow(
            "bfloat16, whole frame",
            (4, 9, 8),
            {**SLIM, "precision": "bfloat16", "crop": None},
            limits=LESS_PRECISE,
        ),
    ),
}
