"""Least-squares fits that start from a network's prediction, as an uncertainty wrapper."""

from collections.abc import Callable
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.distributions.protocol import median
from framework.errors import ConfigError
from framework.model import Predictor
from framework.spectra.fit import density, fit
from framework.spectra.offsets import offsets_of
from framework.spectra.spectrum import PRESETS
from framework.uncertainty import Uncertainty

DRAWS = 100
"""Number of samples from which a density without a known median is summarised."""


class Refined(Uncertainty):
    """Fits Lorentzian lines to each spectrum, starting from the wrapped model's prediction (the neural start).

    The density is that of the fit (`framework.spectra.fit`); the density of the wrapped model only gives the start. It
    is a wrapper, since one experiment needs both a network and a fit: it is trained, stored and compared as any model,
    and wraps any model, also an ensemble. With `steps=0` it equals the wrapped model.

    Attributes:
        steps: largest number of steps of a fit (a knob).

    Args:
        steps: as the attribute.
        offsets: frequency offsets of the data, ppm.
    """

    bibtex = """@article{levenberg1944method,
  author  = {Levenberg, Kenneth},
  title   = {A method for the solution of certain non-linear problems in least squares},
  journal = {Quarterly of Applied Mathematics},
  volume  = {2},
  pages   = {164--168},
  year    = {1944}
}"""
    offsets: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        steps: Annotated[int, Field(ge=0, le=10_000)] = 300,
        offsets: list[float] | None = None,
    ) -> None:
        super().__init__()
        self.knobs = {"steps": (0, 1, 2, 3, 5, 10, 30)}
        self.model = model()
        self.steps = steps
        self.register_buffer("offsets", torch.tensor(offsets_of(offsets), dtype=torch.float64), False)

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the density of the fit that starts from the wrapped model's prediction."""
        start = self.model(inputs)
        if self.steps == 0:
            return start
        wanted = next((one for one in PRESETS.values() if (one.target_count,) == start.event_shape), None)
        if wanted is None or inputs.shape[1:].numel() != len(self.offsets):
            raise ConfigError(
                f"uncertainty refined fits {len(self.offsets)} offsets by 10 or 15 numbers, but the data have inputs "
                f"of {inputs.shape[1:].numel()} and targets of {start.event_shape.numel()}. Choose data=cest."
            )
        point = median(start, DRAWS)
        spectra = inputs.flatten(1)
        found = fit(spectra, self.offsets, wanted, start=point, most=self.steps)
        zero = (spectra * 0).sum(-1, keepdim=True).to(point.dtype)
        return density(found, wanted.target_count, start.batch_shape, zero)
