"""What heads without gradient share (framework.density_head.Fitted): state of any shape, inputs, and refusals."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from framework.errors import ConfigError, UserError
from framework.heads.parameters import require_finite
from framework.target import Target

FLOOR = 1e-4
"""The least standard deviation of a density over reals, in those of the training targets where `Target` has them."""


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


def require_fitted(raw: Float[Tensor, "*batch size"], size: int, by: str) -> Float[Tensor, "*batch size"]:
    """`raw` itself, half precision upcast to float32.

    Raises:
        UserError: `size` is 0, as it is before `fit`.
        ValueError: as framework.heads.parameters.require_finite.
    """
    if size == 0:
        raise UserError(
            f"{by} was not fitted: train it with `python -m framework ...`, or load a trained run with framework.load."
        )
    return require_finite(raw, size)


def single(features: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """On the CPU in float32, in which trees compare; what exceeds it is cut off."""
    most = torch.finfo(torch.float32).max
    return features.detach().clamp(-most, most).to("cpu", torch.float32).contiguous()


def with_gradient_of_0(
    numbers: Float[Tensor, "*batch_and_more"], raw: Float[Tensor, "*batch size"]
) -> Float[Tensor, "*batch_and_more"]:
    """What trees say of `raw` is piecewise constant in it; a gradient is asked for as of any head, and is 0."""
    if not raw.requires_grad:
        return numbers
    zero = (raw * 0).sum(-1)
    return numbers + zero.reshape(*zero.shape, *(1,) * (numbers.dim() - zero.dim()))


def load_any_shape(head: nn.Module, then: Callable[[Any, Any], None]) -> None:
    """Let `load_state_dict` give the head's own buffers the shapes they have in the state, and call `then` afterwards.

    Args:
        then: given the head and torch's lists of missing and unexpected keys; reads what was loaded.
    """
    head.register_load_state_dict_pre_hook(_take_shapes)
    head.register_load_state_dict_post_hook(then)


def _take_shapes(head: nn.Module, state: Mapping[str, Shaped[Tensor, "..."]], prefix: str, *_: Any) -> None:
    """Buffers of a state's shapes, of their own type and device; torch copies the numbers afterwards."""
    for name, buffer in head.named_buffers(recurse=False):
        if prefix + name in state:
            shape = state[prefix + name].shape
            setattr(head, name, torch.empty(shape, dtype=buffer.dtype, device=buffer.device))
