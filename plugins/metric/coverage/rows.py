"""Contract-test cases: classes, real numbers and angles."""

from framework.target import Target
from framework.testing.rows import MetricRow

TOO_BROAD = {
    "perfect beats random": "a fixed density around each target is too broad, and as badly calibrated as a density "
    "around another value"
}
RANDOM_RANKS = dict.fromkeys(
    ("batches do not matter", "order does not matter", "states merge", "reset and copy"),
    "the result depends on draws of the joint density of three angles, which differ between batches",
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
            leave_out=TOO_BROAD | RANDOM_RANKS,
        ),
    )
}
