"""Contract-test cases: sizes even and odd, every normalisation, with and without crop."""

from framework.testing.rows import EncoderRow

UNET = {"width": 6, "levels": 3}
SLIM = {"widths": [8, 12, 16]}
LESS_PRECISE = {"batch rows are independent": 1e-2}  # distance of two neighbouring bfloat16 numbers
AT_FIRST = {"gradients reach every parameter": "the last layer's weights are 0 until the first step"}
ROWS = {
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
