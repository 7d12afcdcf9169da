"""Rows of the contract: both variants on small grids."""

from framework.testing.rows import EncoderRow

ROWS = {
    "voxnet": (
        EncoderRow("voxnet", (1, 16, 16, 16), config={"channels": [4, 4], "widths": [16]}),
        EncoderRow("three channels", (3, 12, 12, 12), config={"channels": [4, 6], "widths": [16, 8]}),
        EncoderRow(
            "conv3d",
            (1, 17, 17, 17),
            config={"variant": "conv3d", "channels": [2, 4, 4, 6], "widths": [16, 16], "dropout": [0.5, 0.3]},
        ),
        EncoderRow(
            "conv3d, padded",
            (3, 8, 8, 8),
            config={
                "variant": "conv3d",
                "channels": [2, 4, 6],
                "widths": [12],
                "dropout": [0.2],
                "padding": 1,
            },
        ),
    )
}
