"""Contract-test cases: vectors and flattened images, with and without batch norm."""

from framework.testing.rows import EncoderRow

ROWS = {
    "mlp": (
        EncoderRow("defaults", (7,)),
        EncoderRow("images", (3, 4, 5), {"widths": [16, 8], "dropout": 0.2}),
        EncoderRow("no layers", (5, 2), {"widths": []}),
        EncoderRow("exponential units", (7,), {"widths": [9, 8], "activation": "elu"}),
        EncoderRow("smooth units", (7,), {"widths": [9, 8], "activation": "silu"}),
        EncoderRow("batch norm", (6, 4), {"widths": [12, 8], "batch_norm": True}),
        EncoderRow(
            "the thesis's blocks",
            (24,),
            {"widths": [12, 8], "batch_norm": "after_relu", "dropout": [0.8, 0.4]},
        ),
    )
}
