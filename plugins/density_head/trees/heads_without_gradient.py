"""What heads without gradient share (framework.density_head.Fitted): state of any shape, inputs, and refusals."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from framework.errors import CheckpointError, ConfigError, UserError, shown
from framework.heads.parameters import require_finite
from framework.target import Target

FLOOR = 1e-4
"""The least standard deviation of a density over reals, in those of the training targets where `Target` has them."""
WIDEST = 1e18
"""The largest standard deviation of such a density: the square of a wider one is more than float32 holds."""


def require_class_or_real(target: Target, by: str) -> None:
    """Refuse targets other than classes and real numbers.

    Raises:
        ConfigError: the target is an angle or an image.
    """
    if target.kind not in ("class", "real"):
        raise ConfigError(
            f"{by} describes targets of kind 'class' or 'real', but this data set's are {target.kind!r} "
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


Arrays = Mapping[str, np.ndarray]


def load_any_shape(
    head: nn.Module, require: Callable[[Any, Arrays], None], then: Callable[[Any, Any], None]
) -> None:
    """Let `load_state_dict` give the head's own buffers the shapes they have in the state, and call `then` afterwards.

    A state is a stranger's: of its arrays nothing is taken before `require` has seen them all.

    Args:
        require: given the head and the arrays that it would have, with the types of its buffers; raises a ValueError
            with a clause that says what is wrong where they do not fit.
        then: given the head and torch's lists of missing and unexpected keys; reads what was loaded.
    """
    head.register_load_state_dict_pre_hook(partial(_take_shapes, require))
    head.register_load_state_dict_post_hook(then)


def _take_shapes(
    require: Callable[[Any, Arrays], None],
    head: nn.Module,
    state: Mapping[str, Any],
    prefix: str,
    *_: Any,
) -> None:
    """Buffers of a state's shapes, of their own type and device; torch copies the numbers afterwards.

    Raises:
        CheckpointError: the state is not of such a head.
    """
    own = dict(head.named_buffers(recurse=False))
    stored = {name: state.get(prefix + name, buffer) for name, buffer in own.items()}
    try:
        require(head, {name: _array(name, stored[name], buffer) for name, buffer in own.items()})
    except ValueError as error:
        raise CheckpointError(
            f"The state of {type(head).__name__} is damaged: {shown(error)}. Load another checkpoint, or train anew."
        ) from None
    for name, buffer in own.items():
        setattr(head, name, torch.empty(stored[name].shape, dtype=buffer.dtype, device=buffer.device))


def _array(name: str, found: Any, buffer: Tensor) -> np.ndarray:
    """What a buffer will hold; floating-point numbers may be of another width, as a model's that was cast."""
    if not isinstance(found, Tensor) or found.layout != torch.strided or found.is_quantized:
        raise ValueError(f"{name} is no array of numbers")
    if found.dtype != buffer.dtype and not (found.is_floating_point() and buffer.is_floating_point()):
        raise ValueError(f"{name} holds numbers of type {found.dtype}; wanted {buffer.dtype}")
    found = found.detach().to("cpu", buffer.dtype)
    return (found.float() if found.dtype == torch.bfloat16 else found).numpy()  # NumPy has no bfloat16
