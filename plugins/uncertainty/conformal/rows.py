"""Contract-test cases: both scores on every kind of target."""

from framework.target import Target
from framework.testing.rows import WrapperRow

ROWS = {
    "conformal": tuple(
        WrapperRow(f"{name}, {score}", target, {"score": score}, identity={})
        for score in ("density", "mass")
        for name, target in {
            "classes": Target("class", ("a", "b", "c")),
            "one angle": Target("angle", ("azimuth",)),
            "one real": Target("real", ("height",)),
            "two reals": Target("real", ("x", "y")),
        }.items()
    )
}
