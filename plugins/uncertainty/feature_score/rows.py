"""Contract-test cases: each distance, for classes, angles and real numbers."""

from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

ROWS = {
    "feature_score": (
        WrapperRow("Mahalanobis, classes", CLASSES, identity={}),
        WrapperRow("Mahalanobis, one angle", ANGLE, {"shrinkage": 0.1}, identity={}),
        WrapperRow("Mahalanobis, two reals", REALS, {"normalise": True}, identity={}),
        WrapperRow("relative Mahalanobis", CLASSES, {"method": "relative_mahalanobis"}, identity={}),
        WrapperRow("nearest neighbours", REALS, {"method": "knn", "neighbours": 3}, identity={}),
        WrapperRow(
            "nearest of few", CLASSES, {"method": "knn", "neighbours": 2, "references": 10}, identity={}
        ),
    )
}
