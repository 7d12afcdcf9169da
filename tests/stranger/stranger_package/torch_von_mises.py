"""Density head around torch.distributions.VonMises, whose faults only the contract tests find."""

import torch
from torch import Tensor
from torch.distributions import Independent, VonMises

from framework.density_head import DensityHead
from framework.target import Target


class TorchVonMisesHead(DensityHead):
    """Density head with torch's own von Mises density, κ = exp(r)."""

    bibtex = ""

    def __init__(self, target: Target) -> None:
        super().__init__()
        target.require("angle", by="torch_von_mises")
        self.angles = len(target.names)
        self.size = 3 * self.angles

    def forward(self, raw: Tensor) -> Independent:
        cos, sin, log_concentration = raw.unflatten(-1, (self.angles, 3)).unbind(-1)
        density = VonMises(torch.atan2(sin, cos), log_concentration.exp(), validate_args=False)
        return Independent(density, 1, validate_args=False)

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return -self(raw).log_prob(target)

    def calibrate(self, raw: Tensor, target: Tensor) -> None:
        pass
