"""Contract-test cases: classes (also with more actions than classes), real numbers, one angle, one of three angles."""

import math

from framework.target import Target
from framework.testing.rows import MetricRow

ASK = {
    "costs": [[0.0, 1.0, 5.0, 2.0], [1e3, 0.0, 1.0, 2.0], [math.inf, 1.0, 0.0, 2.0]],
    "actions": ["go", "slow down", "stop", "ask a person"],
}
SIDES = {"edges_deg": [-45.0, 45.0, 135.0, 225.0]}
ROWS = {
    "decision_cost": (
        MetricRow("five classes", Target("class", ("a", "b", "c", "d", "e"))),
        MetricRow("a person may be asked", Target("class", ("empty", "far", "near")), ASK),
        MetricRow("one real", Target("real", ("height",)), {"edges": [-1.0, 0.5]}),
        MetricRow("one of two reals", Target("real", ("x", "y")), {"edges": [0.0], "number": "y"}),
        MetricRow("one angle", Target("angle", ("azimuth",)), SIDES),
        MetricRow(
            "one of three angles",
            Target("angle", ("azimuth", "elevation", "tilt")),
            {**SIDES, "number": "tilt"},
        ),
    )
}
