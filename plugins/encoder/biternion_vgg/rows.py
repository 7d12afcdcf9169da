"""Contract-test cases: colour and grey images, six convolutions and fewer."""

from framework.testing.rows import EncoderRow

ROWS = {
    "biternion_vgg": (
        EncoderRow("colour", (3, 48, 48), {"features": 20}),
        EncoderRow("grey, not square", (1, 33, 41), {"channels": [3, 4, 4, 3, 4, 5], "features": 9}),
        EncoderRow("three convolutions", (3, 11, 13), {"channels": [4, 6, 8], "features": 12}),
    )
}
