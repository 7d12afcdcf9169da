"""Contract-test cases: each variant, activation and grouping, with and without attributes."""

from framework.testing.rows import CloudRow

COLOURED = ("x", "y", "z", "red", "green", "blue")


def rows(first: CloudRow, second: CloudRow) -> tuple[CloudRow, ...]:
    """Return `first`, `second`, and two more cases with the settings of `second`.

    One of them also reads attributes; the other reads only the first points of a cloud.
    """
    small = second.config
    return (
        first,
        second,
        CloudRow(
            "attributes", (30, 6), {**small, "attributes": True, "normalise": "robust"}, columns=COLOURED
        ),
        CloudRow(
            "the first points",
            (30, 3),
            config={**small, "points": 10, "normalise": "none"},
            leave_out={"points in any order": "only the first points are read"},
        ),
    )


NET = {"point_widths": [8, 8, 8, 12], "widths": [12, 8]}
BALLS = {"width": 0.125, "centroids": [20, 6], "radius": 0.4}
EDGES = {"neighbours": 6, "edge_widths": [8, 12], "point_width": 16, "widths": [12, 8]}
SETS = {"channels": [12, 12], "widths": [8]}
ROWS = {
    "pointnet": rows(
        CloudRow("vanilla", (40, 3), config={**NET, "variant": "vanilla"}),
        CloudRow("full", (40, 3), config=NET),
    ),
    "pointnet2": (
        *rows(
            CloudRow("balls of three sizes", (40, 3), config={**BALLS, "grouping": "multi_scale"}),
            CloudRow("balls of one size", (40, 3), config=BALLS),
        )[:3],
        CloudRow(
            "the first points, as they are",
            (40, 3),
            config={**BALLS, "points": 10, "normalise": "none", "radius": 4.0},
            leave_out={
                "points in any order": "only the first points are read",
                "finite on extreme inputs": "clouds that were not normalised are refused",
            },
        ),
    ),
    "dgcnn": rows(
        CloudRow("one edge convolution", (40, 3), config={**EDGES, "edge_widths": [8]}),
        CloudRow("two edge convolutions", (40, 3), config=EDGES),
    ),
    "deepsets": rows(
        CloudRow("elu", (40, 3), config={**SETS, "activation": "elu"}), CloudRow("tanh", (40, 3), config=SETS)
    ),
}
