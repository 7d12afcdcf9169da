"""Contract-test cases: both scores on every kind of target."""

from framework.target import Target
from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

ROWS = {
    "conformal": tuple(
        WrapperRow(f"{name}, {score}", target, {"score": score}, identity={})
        for score in ("density", "mass")
        for name, target in {
            "classes": CLASSES,
            "one angle": ANGLE,
            "one real": Target("real", ("height",)),
            "two reals": REALS,
        }.items()
    )
}
