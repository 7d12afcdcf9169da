"""Contract-test cases: fits of few steps to few offsets, for both presets."""

from framework.spectra.spectrum import PRESETS
from framework.target import Target
from framework.testing.rows import HeadRow

OFFSETS = [-20.0, -5.0, -3.5, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0, 3.5, 5.0, 20.0]
ROWS = {
    "lorentzian": tuple(
        HeadRow(
            preset,
            Target("real", parameters.target),
            {"offsets": OFFSETS, "steps": 3},
            leave_out={"loss gradient": "the gradient in the spectrum is set to 0"},
        )
        for preset, parameters in PRESETS.items()
    ),
}
