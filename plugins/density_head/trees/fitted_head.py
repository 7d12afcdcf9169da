"""What heads that are fitted at once share (framework.density_head.Fitted): state of any shape, and refusals."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from framework.distributions.protocol import median
from framework.errors import ConfigError, UserError
from framework.target import Target

FLOOR = 1e-4
"""The least standard deviation of a density over reals, which should be of the order of 1."""


class IndependentNormals(Independent):
    """Normal densities of several reals, independent of one another; unlike torch's own also of an empty batch.

    Args:
        mean, scale: (*batch, number).
    """

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        super().__init__(Normal(mean, scale, validate_args=False), 1, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.base_dist.log_prob(value).sum(-1)

    def entropy(self) -> Tensor:
        return self.base_dist.entropy().sum(-1)


@median.register
def _(density: IndependentNormals, samples: int) -> Tensor:
    # each is symmetric about its mean
    return density.mean


def require_no_angle(target: Target, by: str) -> None:
    """Refuse targets other than classes and reals.

    Raises:
        ConfigError: angles.
    """
    if target.kind == "angle":
        raise ConfigError(
            f"{by} describes targets of kind 'class' or 'real', but this data set's are 'angle' "
            f"({target.told}). Choose another density_head, or other data."
        )


def require_fitted(size: int, by: str) -> None:
    """Refuse to predict before `fit`.

    Raises:
        UserError: `size` is 0.
    """
    if size == 0:
        raise UserError(
            f"{by} was not fitted: train it with `python -m framework ...`, or load a trained run with framework.load."
        )


def single(features: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """On the CPU in float32, in which trees compare; what exceeds it is cut off."""
    most = torch.finfo(torch.float32).max
    return features.detach().clamp(-most, most).to("cpu", torch.float32).contiguous()


def take_shapes(module: nn.Module, state: Mapping[str, Shaped[Tensor, "..."]], prefix: str) -> None:
    """Give a module's own buffers the shapes they have in a state, keeping type and device.

    To be called first in its `_load_from_state_dict(state, prefix, ...)`; torch copies the numbers afterwards.
    """
    for name, buffer in module.named_buffers(recurse=False):
        if prefix + name in state:
            shape = state[prefix + name].shape
            setattr(module, name, torch.empty(shape, dtype=buffer.dtype, device=buffer.device))
