"""Contract-test cases: vectors and images, with and without batch norm and the narrow last layer."""

from framework.testing.rows import EncoderRow

ROWS = {
    "dense_blocks": (
        EncoderRow("features", (20,), {"width": 24}),
        EncoderRow("batch norm", (20,), {"width": 24, "batch_norm": True}),
        EncoderRow("standardised features", (20,), {"width": 24, "standardise": True}),
        EncoderRow("narrow last layer", (20,), {"width": 24, "bottleneck": 5}),
        EncoderRow("one block of three layers, images", (1, 6, 4), {"blocks": 1, "layers": 3, "width": 16}),
    )
}
