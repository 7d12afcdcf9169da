"""Rows of the contract: each basis, each kind of feature."""

from framework.testing.rows import EncoderRow

CLOUD = (40, 3)
COLUMNS = ("x", "y", "z", "red", "green", "blue", "normal_x", "normal_y", "normal_z", "echo")
ROWS = {
    "bps": (
        EncoderRow("defaults", CLOUD),
        EncoderRow(
            "grid of deltas",
            CLOUD,
            config={"basis": "grid", "points": 27, "features": ["delta"]},
        ),
        EncoderRow("grid within the ball", CLOUD, config={"basis": "ball_grid", "points": 50}),
        EncoderRow(
            "close packing",
            CLOUD,
            config={"basis": "hexagonal", "points": 50, "radius": 1.5},
        ),
        EncoderRow(
            "attributes",
            (40, 10),
            columns=COLUMNS,
            config={
                "points": 20,
                "features": ["color", "distance", "normal", "echo", "delta"],
                "normalise": "robust",
            },
        ),
        EncoderRow(
            "rotation-invariant",
            (40, 10),
            columns=COLUMNS,
            config={"points": 20, "features": ["distance", "delta", "normal"], "rotation_invariant": True},
        ),
        EncoderRow("one basis point, one point", (1, 3), config={"points": 1}),
    )
}
