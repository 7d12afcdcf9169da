"""Contract-test cases: each form of the covariance and each choice of the prior, for each kind of target."""

from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

FIXED = {"prior_precision": 10.0}
NO_FIT = {
    "calibration does not harm": "the posterior is fitted to the training split, not to the likelihood of the "
    "validation split; densities of a model that is too broad become broader still"
}
ROWS = {
    "laplace": (
        WrapperRow("classes", CLASSES, identity={}, leave_out=NO_FIT),
        WrapperRow("one angle", ANGLE, {"samples": 7}, identity={"samples": 1}, leave_out=NO_FIT),
        WrapperRow(
            "two reals", REALS, {"samples": 4, "covariance": "kronecker"}, identity={}, leave_out=NO_FIT
        ),
        WrapperRow(
            "diagonal",
            REALS,
            {"samples": 5, "covariance": "diagonal", **FIXED},
            identity={},
            leave_out=NO_FIT,
        ),
        WrapperRow("validation", CLASSES, {"prior_precision": "validation", "samples": 4}, identity={}),
        WrapperRow("validation, angle", ANGLE, {"prior_precision": "validation", "samples": 4}, identity={}),
    )
}
