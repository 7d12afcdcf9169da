"""Normal densities of several numbers, independent or correlated; unlike torch's, they accept an empty batch."""

import math

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal

from framework.distributions.protocol import marginal, median, tempered_density


class IndependentNormals(Independent):
    """The normal density of several independent numbers.

    Args:
        mean: mean of each number, (*batch, number).
        scale: standard deviations, (*batch, number).
    """

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        super().__init__(Normal(mean, scale, validate_args=False), 1, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.base_dist.log_prob(value).sum(-1)

    def entropy(self) -> Tensor:
        return self.base_dist.entropy().sum(-1)


@median.register
def _(density: IndependentNormals, samples: int) -> Tensor:
    # each number's density is symmetric about its mean
    return density.mean


@marginal.register
def _(density: IndependentNormals, index: int) -> IndependentNormals:
    column = slice(index, index + 1)
    return IndependentNormals(density.mean[..., column], density.base_dist.scale[..., column])


@tempered_density.register
def _(density: IndependentNormals, temperature: Tensor) -> IndependentNormals:
    # exp(-d²/2σ²)^(1/T) = exp(-d²/2σ²T)
    return IndependentNormals(density.mean, density.base_dist.scale * temperature.sqrt())


class JointNormal(MultivariateNormal):
    """The normal density of several correlated numbers, with covariance R Rᵀ.

    Args:
        mean: mean of each number, (*batch, number).
        root: R, (*batch, number, number), lower triangular with a diagonal above 0.
    """

    def __init__(self, mean: Tensor, root: Tensor) -> None:
        self.root = root
        super().__init__(mean, scale_tril=root, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        residual = (value - self.loc).unsqueeze(-1)
        root = self.root.expand(*residual.shape[:-2], *self.root.shape[-2:])
        standard = torch.linalg.solve_triangular(root, residual, upper=False).squeeze(-1)
        scale = self.root.diagonal(dim1=-2, dim2=-1)
        return -(standard.square() / 2 + scale.log() + math.log(2 * math.pi) / 2).sum(-1)

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        with torch.autocast(
            self.loc.device.type, enabled=False
        ):  # autocast would round the product with the root
            return super().rsample(torch.Size(sample_shape))


@marginal.register
def _(density: JointNormal, index: int) -> JointNormal:
    row = density.root[..., index, :]
    # root of R Rᵀ's diagonal, without squares that overflow
    deviation = torch.linalg.vector_norm(row, dim=-1)
    return JointNormal(density.loc[..., index : index + 1], deviation[..., None, None])


@tempered_density.register
def _(density: JointNormal, temperature: Tensor) -> JointNormal:
    return JointNormal(density.loc, density.root * temperature.sqrt())
