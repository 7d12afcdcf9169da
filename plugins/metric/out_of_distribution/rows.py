"""Contract-test cases: entropy, confidence and mutual information, for classes, real numbers and angles."""

from framework.testing.rows import ANGLE, CLASSES, REALS, MetricRow

SINGLE = {"perfect beats random": "the densities are those of single models, without mutual information"}
ROWS = {
    "out_of_distribution": (
        MetricRow("entropy of classes", CLASSES),
        MetricRow("confidence in a class", CLASSES, {"score": "confidence"}),
        MetricRow("entropy of reals", REALS),
        MetricRow("confidence in reals", REALS, {"score": "confidence"}),
        MetricRow("mutual information of reals", REALS, {"score": "mutual_information"}, leave_out=SINGLE),
        MetricRow("entropy of an angle", ANGLE),
        MetricRow("confidence in an angle", ANGLE, {"score": "confidence"}),
    )
}
