"""Rows of the contract: targets of every kind."""

from framework.target import Target
from framework.testing.rows import MetricRow

TOO_BROAD = {
    "perfect beats random": "a fixed density about each target is too broad, as badly calibrated as one about elsewhere"
}
DRAWN = dict.fromkeys(
    ("batches do not matter", "order does not matter", "states merge", "reset and copy"),
    "ranks among draws of the joint density of three angles, which differ from batch to batch",
)
ROWS = {
    "coverage": (
        MetricRow("two classes", Target("class", ("off", "on"))),
        MetricRow("five classes", Target("class", ("a", "b", "c", "d", "e"))),
        MetricRow("one real", Target("real", ("height",)), leave_out=TOO_BROAD),
        MetricRow("two reals", Target("real", ("x", "y")), leave_out=TOO_BROAD),
        MetricRow("one angle", Target("angle", ("azimuth",)), leave_out=TOO_BROAD),
        MetricRow(
            "three angles",
            Target("angle", ("azimuth", "elevation", "tilt")),
            {"samples": 50},
            leave_out=TOO_BROAD | DRAWN,
        ),
    )
}
