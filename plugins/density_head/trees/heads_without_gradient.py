"""Functions that both heads of trees share: checks, conversion of inputs, gradients of 0, and loading of states."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from framework.errors import CheckpointError, ConfigError, UserError, shorten
from framework.heads.parameters import require_finite
from framework.target import Target

FLOOR = 1e-4
"""Smallest standard deviation of a density over reals.

The unit is the standard deviation of the training targets, if `Target` has it.
"""
WIDEST = 1e18
"""Largest standard deviation of a density over reals; the square of a larger one exceeds float32."""


def require_class_or_real(target: Target, by: str) -> None:
    """Require a target of classes or real numbers; `by` is the subject of the message, such as the head's name.

    Raises:
        ConfigError: the target is an angle or an image.
    """
    if target.kind not in ("class", "real"):
        raise ConfigError(
            f"{by} describes targets of kind 'class' or 'real', but the targets of this data set are {target.kind!r} "
            f"({target.listed_names}). Choose another density_head, or other data."
        )


def require_fitted(raw: Float[Tensor, "*batch size"], size: int, by: str) -> Float[Tensor, "*batch size"]:
    """Return `raw`, with half precision converted to float32.

    Args:
        raw: features that the head reads.
        size: number of features to which the head was fitted.
        by: subject of the message, such as the head's name.

    Raises:
        UserError: `size` is 0, as it is before `fit`.
        ValueError: `raw` is not finite or has another size (framework.heads.parameters.require_finite).
    """
    if size == 0:
        raise UserError(
            f"{by} is not fitted yet. Train the head with `python -m framework ...`, or load a trained run with "
            "framework.load."
        )
    return require_finite(raw, size)


def single(features: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the features on the CPU in float32, clamped to the range of float32; trees compare in this type."""
    most = torch.finfo(torch.float32).max
    return features.detach().clamp(-most, most).to("cpu", torch.float32).contiguous()


def with_gradient_of_0(
    numbers: Float[Tensor, "*batch_and_more"], raw: Float[Tensor, "*batch size"]
) -> Float[Tensor, "*batch_and_more"]:
    """Return `numbers` with a gradient of 0 with respect to `raw`.

    The framework needs a gradient from every head. The output of trees is piecewise constant in `raw`, so that its
    gradient is 0.
    """
    if not raw.requires_grad:
        return numbers
    zero = (raw * 0).sum(-1)
    return numbers + zero.reshape(*zero.shape, *(1,) * (numbers.dim() - zero.dim()))


Arrays = Mapping[str, np.ndarray]


def load_any_shape(
    head: nn.Module, require: Callable[[Any, Arrays], None], then: Callable[[Any, Any], None]
) -> None:
    """Make `load_state_dict` give the head's own buffers the shapes of the state, and call `then` afterwards.

    A state may come from an untrusted source: `require` checks all arrays before any of them is used.

    Args:
        head: the module whose buffers take the shapes of a state.
        require: function of the head and of the stored arrays, converted to the dtypes of the buffers. It raises a
            ValueError if they do not fit; the message is a clause that says what is wrong.
        then: function of the head and of torch's lists of missing and unexpected keys, called after the buffers are
            loaded.
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
    """Replace the head's buffers by empty ones that have the shapes of the stored tensors.

    Dtypes and devices of the buffers stay. Torch copies the stored numbers into them afterwards.

    Raises:
        CheckpointError: `require` refuses the state.
    """
    own = dict(head.named_buffers(recurse=False))
    stored = {name: state.get(prefix + name, buffer) for name, buffer in own.items()}
    try:
        require(head, {name: _array(name, stored[name], buffer) for name, buffer in own.items()})
    except ValueError as error:
        raise CheckpointError(
            f"The state of {type(head).__name__} is damaged: {shorten(error)}. Load another checkpoint, or train the "
            "head again."
        ) from None
    for name, buffer in own.items():
        setattr(head, name, torch.empty(stored[name].shape, dtype=buffer.dtype, device=buffer.device))


def _array(name: str, stored: Any, buffer: Tensor) -> np.ndarray:
    """Return a stored tensor as an array of the buffer's dtype.

    Floating-point numbers may have another precision than the buffer, as in the state of a model in half precision.
    """
    if not isinstance(stored, Tensor) or stored.layout != torch.strided or stored.is_quantized:
        raise ValueError(f"the stored value of `{name}` is not a dense array of numbers")
    if stored.dtype != buffer.dtype and not (stored.is_floating_point() and buffer.is_floating_point()):
        raise ValueError(f"the stored array `{name}` has the dtype {stored.dtype}; expected {buffer.dtype}")
    stored = stored.detach().to("cpu", buffer.dtype)
    return (stored.float() if stored.dtype == torch.bfloat16 else stored).numpy()  # NumPy has no bfloat16
