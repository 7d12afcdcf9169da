"""Contract-test cases: each basis and each kind of feature."""

from framework.testing.rows import CloudRow

CLOUD = (40, 3)
COLUMNS = ("x", "y", "z", "red", "green", "blue", "normal_x", "normal_y", "normal_z", "echo")
ROWS = {
    "bps": (
        CloudRow("defaults", CLOUD),
        CloudRow(
            "grid of deltas",
            CLOUD,
            config={"basis": "grid", "points": 27, "features": ["delta"]},
        ),
        CloudRow("grid within the ball", CLOUD, config={"basis": "ball_grid", "points": 50}),
        CloudRow(
            "close packing",
            CLOUD,
            config={"basis": "hexagonal", "points": 50, "radius": 1.5},
        ),
        CloudRow(
            "attributes",
            (40, 10),
            columns=COLUMNS,
            config={
                "points": 20,
                "features": ["color", "distance", "normal", "echo", "delta"],
                "normalise": "robust",
            },
        ),
        CloudRow(
            "rotation-invariant",
            (40, 10),
            columns=COLUMNS,
            config={"points": 20, "features": ["distance", "delta", "normal"], "rotation_invariant": True},
        ),
        CloudRow("selected, before the fit", CLOUD, config={"basis": "selected", "points": 20}),
        CloudRow(
            "learned, before the fit", CLOUD, config={"basis": "selected", "points": 20, "learned": True}
        ),
        CloudRow("learned", CLOUD, config={"points": 20, "learned": True, "features": ["distance", "delta"]}),
        CloudRow("one basis point, one point", (1, 3), config={"points": 1}),
    )
}
