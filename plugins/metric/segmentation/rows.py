"""Contract-test cases: every test case is a scan of its own, so that the jackknife over scans is that over cases."""

import torch

from framework.target import Target
from framework.testing.rows import MetricRow

SCANS = {"scan": torch.arange}
ROWS = {
    "segmentation": (
        MetricRow("two classes", Target("class", ("off", "on")), fields=SCANS),
        MetricRow("five classes", Target("class", ("a", "b", "c", "d", "e")), fields=SCANS),
    )
}
