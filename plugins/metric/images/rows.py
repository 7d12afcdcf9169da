"""Contract-test cases: images of balls."""

from framework.target import Target
from framework.testing.rows import MetricRow

PLACE = Target("real", ("across", "down"))

ROWS = {
    "psnr": (
        MetricRow("inside the mask too", PLACE),
        MetricRow(
            "linear light, full frame", PLACE, {"encoding": "linear", "masked": False, "ceiling_db": 60.0}
        ),
    ),
    "ssim": (
        MetricRow("inside the mask too", PLACE),
        MetricRow("linear light, one window", PLACE, {"encoding": "linear", "masked": False}, size=(11, 11)),
    ),
    "ms_ssim": (
        MetricRow("two scales", PLACE, {"scales": 2}),
        MetricRow("three scales, smallest images", PLACE, {"scales": 3}, size=(44, 45)),
    ),
    "lpips": (
        MetricRow(
            "without weights",
            PLACE,
            leave_out={
                "named numbers": "all results are NaN without weights; test_lpips.py uses random weights"
            },
        ),
    ),
    "silhouette_iou": (MetricRow("balls", PLACE), MetricRow("images of one row", PLACE, size=(1, 40))),
    "depth_error": (MetricRow("balls", PLACE),),
}
