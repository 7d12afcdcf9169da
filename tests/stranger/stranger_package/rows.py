"""Rows of the contract: `mode=check density_head=wrapped_cauchy` finds them beside the head's module."""

import numpy as np
import torch
from scipy import stats

from framework.target import Target
from framework.testing.rows import Case, HeadRow, WrapperRow


def cases(head):
    """Return SciPy's wrapped Cauchy density with mean 0."""
    value = np.linspace(-3, 3, 13, dtype=np.float32).astype(np.float64)
    for spread in (-30.0, -1.0, 0.0, 4.0):
        length = head.largest / (1 + np.exp(-spread))
        raw = torch.tensor([[1.0, 0.0, spread]], dtype=torch.float64).repeat(len(value), 1)
        log_prob = torch.from_numpy(stats.wrapcauchy.logpdf(value % (2 * np.pi), length))
        yield Case(f"length {length:.3g}", raw, torch.from_numpy(value)[:, None], log_prob)


AZIMUTH = Target("angle", ("azimuth",))
ROWS = {
    "committee": (WrapperRow("three", AZIMUTH, identity={"members": 1}),),
    "averaged_committee": (WrapperRow("three", AZIMUTH, identity={"members": 1}),),
    "wrapped_cauchy": (
        HeadRow("one angle", Target("angle", ("azimuth",)), cases=cases),
        HeadRow("two angles", Target("angle", ("azimuth", "elevation")), {"largest": 0.9}),
    ),
    # one row, since its sampler hangs until the check of a row is ended
    "torch_von_mises": (HeadRow("one angle", AZIMUTH),),
}
