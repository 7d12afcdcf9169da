"""Contract-test cases: two scores on every kind of target, and quantiles of one real number."""

from framework.target import Target
from framework.testing.rows import ANGLE, CLASSES, REALS, WrapperRow

HEIGHT = Target("real", ("height",))
ROWS = {
    "conformal": (
        *(
            WrapperRow(f"{name}, {score}", target, {"score": score}, identity={})
            for score in ("density", "mass")
            for name, target in {
                "classes": CLASSES,
                "one angle": ANGLE,
                "one real": HEIGHT,
                "two reals": REALS,
            }.items()
        ),
        WrapperRow("one real, quantiles", HEIGHT, {"score": "quantiles"}, identity={}),
    )
}
