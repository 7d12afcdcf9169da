"""Contract-test cases: a ball's positions at the next two frames, from the last four."""

from framework.testing.flights import TWO_FRAMES
from framework.testing.rows import HeadRow

NOT_SMOOTH = "the state is found by a search, and the gradient in the input is set to 0"
ROWS = {
    "ballistic": tuple(
        HeadRow(
            density,
            TWO_FRAMES,
            # identification from random numbers takes a second each time; test_flight_heads.py tests identification
            {"observed": 4, "density": density, "steps": 6, "identify": False},
            leave_out={"loss gradient": NOT_SMOOTH},
        )
        for density in ("linearised", "sampled")
    ),
    "lstm": (HeadRow("two frames", TWO_FRAMES, {"observed": 4, "hidden": 8}),),
}
