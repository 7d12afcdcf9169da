"""Contract-test cases: small images, with a mask and without."""

import torch

from framework.target import Target
from framework.testing.rows import MetricRow

COLOURED = Target("image", ("red", "green", "blue"), size=(6, 5))


def masks(count: int) -> torch.Tensor:
    """Return different masks for `count` images; the last mask is empty."""
    mask = torch.arange(30).view(6, 5) % (2 + torch.arange(count).view(-1, 1, 1) % 3) == 0
    return mask & (torch.arange(count) < count - 1).view(-1, 1, 1)


ROWS = {
    "pixel_uncertainty": (
        MetricRow("inside the mask too", COLOURED, fields={"mask": masks}),
        MetricRow(
            "grey, the frame alone, not rounded",
            Target("image", ("grey",), size=(4, 7)),
            {"masked": False, "steps": 0},
        ),
    )
}
