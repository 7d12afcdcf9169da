"""Contract-test cases: large and small grids, several truncations, both variants of the convolutions."""

from framework.testing.rows import CloudRow, EncoderRow

CONV3D = {"variant": "conv3d", "channels": [2, 4, 4, 6], "widths": [16, 16], "dropout": [0.5, 0.3]}
PADDED = {"variant": "conv3d", "channels": [2, 4, 6], "widths": [12], "dropout": [0.2], "padding": 1}
ROWS = {
    "occupancy": (
        CloudRow("defaults", (40, 3)),
        CloudRow("small grid, attributes", (40, 6), config={"side": 4, "normalise": "robust"}),
        CloudRow("one cell, one point", (1, 3), config={"side": 1}),
    ),
    "tdf": (
        CloudRow("defaults", (40, 3)),
        CloudRow("within the cell", (40, 3), config={"side": 8, "truncation": 0.5}),
        CloudRow("small grid, wide", (40, 6), config={"side": 4, "truncation": 2.5, "normalise": "robust"}),
        CloudRow("one cell, one point", (1, 3), config={"side": 1}),
    ),
    "voxnet": (
        EncoderRow("voxnet", (1, 16, 16, 16), config={"channels": [4, 4], "widths": [16]}),
        EncoderRow("three channels", (3, 12, 12, 12), config={"channels": [4, 6], "widths": [16, 8]}),
        EncoderRow("conv3d", (1, 17, 17, 17), config=CONV3D),
        EncoderRow("conv3d, padded", (3, 8, 8, 8), config=PADDED),
    ),
}
