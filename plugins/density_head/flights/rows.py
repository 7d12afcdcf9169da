"""Rows of the contract: a ball's positions at the next two frames, from the last four."""

from framework.testing.flights import TWO_FRAMES
from framework.testing.rows import HeadRow

NOT_SMOOTH = "a search from what was seen; no gradient is claimed (forward says so)"
ROWS = {
    "ballistic": tuple(
        HeadRow(
            density,
            TWO_FRAMES,
            # test_flight_heads.py identifies constants; from random numbers it takes a second each time
            {"observed": 4, "density": density, "steps": 6, "identify": False},
            leave_out={"loss gradient": NOT_SMOOTH},
        )
        for density in ("linearised", "sampled")
    ),
    "lstm": (HeadRow("two frames", TWO_FRAMES, {"observed": 4, "hidden": 8}),),
}
