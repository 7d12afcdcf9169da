"""Lorentzian lines fitted to each Z-spectrum, as a density head that needs no gradient."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead, Fitted
from framework.errors import ConfigError
from framework.heads.parameters import require_finite
from framework.spectra.fit import density, fit
from framework.spectra.offsets import offsets_of
from framework.spectra.spectrum import PRESETS, Parameters
from framework.target import Target


class LorentzianHead(DensityHead, Fitted):
    """A least-squares fit of Lorentzian lines to each spectrum (`framework.spectra.fit`).

    The density is normal, and its covariance follows from the Jacobian of the fit. The head reads spectra of
    `data=cest` unchanged, without an encoder, and needs no training and no calibration. The names of the target's
    numbers decide which preset of parameters (framework.spectra.spectrum) is fitted. The gradient of the density
    with respect to the spectrum is set to 0.

    Attributes:
        steps: largest number of steps of a fit (a knob).

    Args:
        steps: initial value of the attribute.
        offsets: frequency offsets of the data, ppm; None for `framework.spectra.offsets.OFFSETS`.

    Raises:
        ConfigError: no preset has this target.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"steps": (1, 3, 10, 30, 100)}
    bibtex = "zaiss2011quantitative"
    offsets: Tensor

    def __init__(
        self,
        target: Target,
        *,
        steps: Annotated[int, Field(ge=1, le=10_000)] = 300,
        offsets: list[float] | None = None,
    ) -> None:
        super().__init__()
        target.require("real", by="density_head lorentzian")
        self.wanted = parameters_of(target.names, by="density_head lorentzian")
        self.steps = steps
        self.scaled = bool(target.scale)
        self.register_buffer("offsets", torch.tensor(offsets_of(offsets), dtype=torch.float64), False)
        self.size = len(self.offsets)

    def fit(self, features: Float[Tensor, "sample size"], target: Tensor, seed: int) -> None:
        """Do nothing, since each spectrum is fitted separately in `forward`."""

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        raw = require_finite(raw, self.size)
        fitted = fit(raw.reshape(-1, self.size), self.offsets, self.wanted, most=self.steps)
        zero = (raw * 0).sum(-1, keepdim=True)
        zero = zero.double() if self.scaled else zero
        return density(fitted, self.wanted.target_count, raw.shape[:-1], zero)


def parameters_of(names: tuple[str, ...], by: str) -> Parameters:
    """Return the parameters of the preset (framework.spectra.spectrum) whose target has the names `names`.

    Args:
        names: names of the numbers of the target.
        by: subject of the message, such as "density_head lorentzian".

    Raises:
        ConfigError: no preset has a target with these names.
    """
    for preset in PRESETS.values():
        if preset.target == names:
            return preset
    known = " or ".join(str(len(preset.target)) for preset in PRESETS.values())
    raise ConfigError(
        f"{by} fits {known} parameters of Lorentzian lines, such as {', '.join(PRESETS['ten'].target[:2])}, but the "
        f"targets of this data set are {', '.join(names[:10])}. Choose data=cest."
    )
