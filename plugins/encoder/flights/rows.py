"""Contract-test cases: observed frames of thrown balls."""

from framework.testing.flights import falling_balls
from framework.testing.rows import EncoderRow

ROWS = {
    name: (EncoderRow("a thrown ball", (30,), {"future": 3}, inputs=falling_balls),)
    for name in ("ballistic", "extrapolation")
}
