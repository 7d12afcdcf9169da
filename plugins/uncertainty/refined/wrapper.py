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
"""Number of samples from which the median is computed if a density does not provide it."""


class Refined(Uncertainty):
    """Least-squares fit of Lorentzian lines to each spectrum, starting from the wrapped model's prediction.

    The returned density describes the fitted parameters (`framework.spectra.fit`); the density of the wrapped model
    only gives the starting point. The fit is a wrapper, so that network and fit are one experiment: they are trained,
    stored and compared together, like any model. Any model can be wrapped, also an ensemble. With `steps=0` the wrapped
    model's density is returned.

    Attributes:
        steps: largest number of steps of a fit, which may be changed after training (a knob).

    Args:
        steps: initial value of the attribute.
        offsets: frequency offsets of the data, ppm; None for `framework.spectra.offsets.OFFSETS`.
    """

    bibtex = "levenberg1944method"
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
        preset = next(
            (preset_ for preset_ in PRESETS.values() if (preset_.target_count,) == start.event_shape), None
        )
        if preset is None or inputs.shape[1:].numel() != len(self.offsets):
            raise ConfigError(
                f"uncertainty refined fits 10 or 15 parameters to spectra of {len(self.offsets)} offsets, but the "
                f"inputs have {inputs.shape[1:].numel()} numbers and the targets {start.event_shape.numel()}. Choose "
                "data=cest."
            )
        point = median(start, DRAWS)
        spectra = inputs.flatten(1)
        fitted = fit(spectra, self.offsets, preset, start=point, most=self.steps)
        zero = (spectra * 0).sum(-1, keepdim=True).to(point.dtype)
        return density(fitted, preset.target_count, start.batch_shape, zero)
