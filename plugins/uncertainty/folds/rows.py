"""Contract-test cases: small cross-fitted ensembles for each kind of target.

No case has an identity, a setting with which the wrapper equals the model: each sample needs a model that did not see
it, so that there are at least two models.
"""

from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

SHORT = {"steps": 10, "epochs": 1}
ROWS = {
    "folds": (
        WrapperRow("reals", REALS, {"folds": 2, **SHORT}),
        WrapperRow("reals, narrowed", REALS, {"folds": 2, "sharpen": True, **SHORT}),
        WrapperRow("classes", CLASSES, {"folds": 3, **SHORT}),
        WrapperRow(
            "one angle, one group",
            ANGLE,
            {"folds": 2, "dropout": [0.2], "weight_decay": [0.0], **SHORT},
        ),
    )
}
