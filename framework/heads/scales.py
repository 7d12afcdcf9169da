"""Scales of heads of real numbers: their map from raw parameters, and losses whose gradient they balance."""

import torch
from jaxtyping import Float
from torch import Tensor

LARGEST_SCALE = 1e12
"""Largest scale that a raw parameter gives."""


def scale_of_raw(raw: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the scale for a raw parameter r: σ = exp(r) for r ≤ 0, and σ = (1 + r/4)⁴ for r > 0.

    σ is a smooth function of r, 1 at r = 0, and at most LARGEST_SCALE.

    The Fisher information of log σ is constant, so that a logarithmic map trains best. The fourth power keeps σ from
    exploding at an outlier.
    """
    most = 4 * (LARGEST_SCALE**0.25 - 1)
    high = (1 + raw.clamp(0.0, most) / 4).square().square()
    return torch.where(raw < 0, torch.exp(raw.clamp(max=0.0)), high)


def balance_losses(
    losses: Float[Tensor, "*batch number"], scale: Float[Tensor, "*batch number"], balance: float
) -> Float[Tensor, "*batch number"]:
    """Return the losses of each number, but with gradients multiplied by the number's scale to the power 2β.

    This is the loss β-NLL of Seitzer et al. 2022, except that the value of the losses is unchanged. With β = 0, the
    wider the scale of a number is, the more slowly its location is learned. With β = 1, all locations are learned as
    with squared error.

    Args:
        losses: negative log-likelihood of each number.
        scale: scale of each number's density; no gradient flows through the factor.
        balance: β, 0 to 1.
    """
    share = scale.detach() ** (2 * balance)
    return losses.detach() + share * (losses - losses.detach())
