"""Contract rows: targets with which `mode=check` tests the plugin."""

from framework.target import Target
from framework.testing.rows import MetricRow

ROWS = {
    "example": (
        MetricRow("one number", Target("real", ("height",))),
        MetricRow("three numbers", Target("real", ("x", "y", "z"))),
    )
}
