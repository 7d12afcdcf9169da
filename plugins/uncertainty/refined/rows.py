"""Contract-test cases: a fit of no steps, which returns the model's density unchanged, and a fit of ten steps."""

from framework.spectra.spectrum import PRESETS
from framework.target import Target
from framework.testing.rows import WrapperRow

TEN = Target("real", PRESETS["ten"].target)
OFFSETS = [-1.0, -0.4, 0.0, 0.4, 1.0, 2.0]
BY_DRAWS = "the density is over ten numbers; the cases of density_head lorentzian integrate it by samples"
TEN_NUMBERS = {"integral": BY_DRAWS, "samples follow log_prob": BY_DRAWS}
ROWS = {
    "refined": (
        WrapperRow(
            "no step", TEN, {"steps": 0, "offsets": OFFSETS}, identity={"steps": 0}, leave_out=TEN_NUMBERS
        ),
        WrapperRow("a fit", TEN, {"steps": 10, "offsets": OFFSETS}, leave_out=TEN_NUMBERS),
    ),
}
