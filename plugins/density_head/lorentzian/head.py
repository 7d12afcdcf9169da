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

    The covariance of the parameters follows from the Jacobian. The head reads spectra of `data=cest` unchanged, without
    an encoder, and needs no training. The target decides which preset is fitted. The gradient of the density in the
    spectrum is set to 0.

    Attributes:
        steps: largest number of steps of a fit (a knob).

    Args:
        steps: as the attribute.
        offsets: frequency offsets of the data, ppm.

    Raises:
        ConfigError: the target is that of no preset.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"steps": (1, 3, 10, 30, 100)}
    bibtex = """@article{zaiss2011quantitative,
  author  = {Zaiss, Moritz and Schmitt, Benjamin and Bachert, Peter},
  title   = {Quantitative separation of {CEST} effect from magnetization transfer and spillover effects by
             {Lorentzian}-line-fit analysis of z-spectra},
  journal = {Journal of Magnetic Resonance},
  volume  = {211},
  pages   = {149--155},
  year    = {2011}
}"""
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
        """Do nothing, since each spectrum is fitted on its own."""

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density for raw parameters."""
        raw = require_finite(raw, self.size)
        found = fit(raw.reshape(-1, self.size), self.offsets, self.wanted, most=self.steps)
        zero = (raw * 0).sum(-1, keepdim=True)
        zero = zero.double() if self.scaled else zero
        return density(found, self.wanted.target_count, raw.shape[:-1], zero)


def parameters_of(names: tuple[str, ...], by: str) -> Parameters:
    """Return the preset whose target has these names.

    Raises:
        ConfigError: no preset has them.
    """
    for preset in PRESETS.values():
        if preset.target == names:
            return preset
    known = " or ".join(str(len(preset.target)) for preset in PRESETS.values())
    raise ConfigError(
        f"{by} fits Lorentzian lines, {known} numbers such as {', '.join(PRESETS['ten'].target[:2])}; the data's are "
        f"{', '.join(names[:10])}. Choose data=cest."
    )
