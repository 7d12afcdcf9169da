"""The evidential head: the predictive density of a normal distribution whose mean and variance have a prior."""

from typing import Annotated

from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.nn.functional import hardtanh

from framework.heads.parameters import require_finite
from framework.heads.scales import scale_of_raw
from framework.heads.unit import HeadOfReals
from framework.target import Target
from plugins.density_head.student_t.density import NORMAL, StudentT
from plugins.density_head.student_t.head import LARGEST_LOCATION

LEAST_ALPHA = 1.05
"""Least α, so that the degrees of freedom 2 α are at least 2.1, and the variance is finite."""
LEAST_EVIDENCE = 1e-6
"""Least ν, the number of virtual observations of the mean."""


class EvidentialHead(HeadOfReals):
    """Student's t density of a normal number whose mean and variance have a predicted prior (Amini et al. 2020).

    For each number, the network predicts γ, ν, α and β of the prior N(μ; γ, σ²/ν) Γ⁻¹(σ²; α, β) of the unknown mean μ
    and variance σ². Integration over μ and σ² gives the density of the target: Student's t with 2 α degrees of freedom,
    the location γ and the squared scale β (1 + ν) / (ν α) (eq. 7-8). The head is trained by its likelihood. A penalty
    λ |y - γ| (2 ν + α) reduces the evidence for predictions that are wrong (eq. 9-10). The aleatoric variance is
    β / (α - 1), and the epistemic one is β / (ν (α - 1)); `evidence` returns γ, ν, α and √β.

    For each number, the head reads four raw parameters. The first is γ itself. ν - LEAST_EVIDENCE, α - LEAST_ALPHA and
    √β are the positive function `scale_of_raw` of the other three. If `Target` has the mean and the standard deviations
    of the training targets, raw parameters describe the target minus this mean, in these standard deviations.

    Args:
        evidence_weight: λ. The likelihood depends on ν and β only through one number, so that the penalty alone
            determines how the variance is divided into aleatoric and epistemic (Meinert et al. 2023).
        floor: smallest scale, in the unit of the raw parameters.
    """

    bibtex = "amini2020deep, meinert2023unreasonable"

    def __init__(
        self,
        target: Target,
        *,
        evidence_weight: Annotated[float, Field(ge=0, le=1e3)] = 0.01,
        floor: Annotated[float, Field(ge=1e-6, le=1.0)] = 1e-3,
    ) -> None:
        super().__init__(target, "evidential", floor)
        self.evidence_weight = evidence_weight
        self.size = 4 * self.numbers

    def forward(self, raw: Float[Tensor, "*batch size"]) -> StudentT:
        """Return the density for raw parameters."""
        density = self._density(*self.evidence(raw))
        location, scale, _ = self.unit.to_target_unit(density.location, density.scale)
        return StudentT(location, scale, density.freedom.to(location))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the negative log-likelihood of each sample, nats.

        The value does not contain the penalty of the class. The gradient is that of the negative log-likelihood plus
        the penalty.
        """
        location, nu, alpha, root_beta = self.evidence(raw)
        value = self.unit.standardise(target).to(location)
        losses = -self._density(location, nu, alpha, root_beta).each_log_prob(value)
        if self.evidence_weight:
            penalty = self.evidence_weight * (value - location).abs() * (2 * nu + alpha)
            losses = losses + (penalty - penalty.detach())
        return losses.sum(-1) + self.unit.log_volume

    def evidence(self, raw: Float[Tensor, "*batch size"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return γ, ν, α and √β, (*batch, number) each, in the unit of the raw parameters."""
        parts = require_finite(raw, self.size).unflatten(-1, (-1, self.numbers)).unbind(-2)
        location = hardtanh(parts[0], -LARGEST_LOCATION, LARGEST_LOCATION)
        nu, alpha, root_beta = (scale_of_raw(part) for part in parts[1:])
        return location, LEAST_EVIDENCE + nu, LEAST_ALPHA + alpha.clamp(max=NORMAL / 4), root_beta

    def _density(self, location: Tensor, nu: Tensor, alpha: Tensor, root_beta: Tensor) -> StudentT:
        scale = self.floor + root_beta * ((1 + 1 / nu) / alpha).sqrt()
        return StudentT(location, scale, 2 * alpha)
