"""Contract-test cases: images of few pixels, with log-densities from a 50-digit reference."""

from collections.abc import Iterator

import mpmath
import torch

from framework.density_head import DensityHead
from framework.target import Target
from framework.testing.rows import Case, HeadRow

SMALL = Target("image", ("red", "green", "blue"), size=(2, 3))
GREY = Target("image", ("grey",), size=(1, 1))
OFFSETS = (0.0, 1e-6, 0.5, -1.0, 30.0)


def laplace_cases(head: DensityHead) -> Iterator[Case]:
    """Yield cases with the reference log p = Σ -|d|/b - log 2b.

    d is the distance of the target from the location. b is exp(r), clamped, for a predicted log-scale r, and 1 if no
    scale is predicted.
    """
    channels, *size = head.raw_shape
    numbers, pixels = (3, 6) if size == [2, 3] else (1, 1)
    for log_scale in (-100.0, -3.0, 0.0, 2.0, 40.0) if channels > numbers else (0.0,):
        with mpmath.workdps(50):
            scale = min(max(mpmath.e**log_scale, mpmath.mpf("1e-4")), mpmath.mpf("1e6"))
            log_prob = [
                float(numbers * pixels * (-abs(mpmath.mpf(offset)) / scale - mpmath.log(2 * scale)))
                for offset in torch.tensor(OFFSETS).double().tolist()
            ]
        raw = torch.zeros(len(OFFSETS), *head.raw_shape, dtype=torch.float64)
        raw[:, numbers:] = log_scale
        value = torch.tensor(OFFSETS).double().reshape(-1, 1, 1, 1)
        value = value.expand(-1, *size, numbers)
        yield Case(f"r = {log_scale:g}", raw, value, torch.tensor(log_prob, dtype=torch.float64))


ROWS = {
    "laplace_image": (
        HeadRow("one scale", SMALL, cases=laplace_cases),
        HeadRow("a scale for each pixel", SMALL, {"scale": "pixel"}, cases=laplace_cases),
        HeadRow("a scale for each number", SMALL, {"scale": "number"}, cases=laplace_cases),
        # finite differences at raw parameters of size 1000 step over the kink of |d| at a sample
        HeadRow(
            "one grey pixel", GREY, {"scale": "number"}, cases=laplace_cases, limits={"loss gradient": 0.1}
        ),
        HeadRow(
            "balanced, fitted to intervals",
            SMALL,
            {"scale": "pixel", "balance": 1.0, "cover": 0.9, "floor": 0.002},
            leave_out={"loss gradient": "the gradient is weighted by the scale, while the loss is not"},
        ),
        HeadRow(
            "foreground",
            SMALL,
            {"scale": "pixel", "foreground": 5.0},
            leave_out={
                "loss is least for its own density": "the loss weights pixels by the true image, so it is not proper",
                "loss is in nats": "the loss weights pixels by the true image, while log_prob does not",
            },
        ),
    )
}
