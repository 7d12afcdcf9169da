"""Shared parts of heads without gradient (framework.density_head.Fitted): loading of state, inputs, and refusals."""

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
"""Smallest standard deviation of a density over reals, in units of the training targets' one where `Target` has it."""
WIDEST = 1e18
"""Largest standard deviation of such a density: the square of a larger one exceeds float32."""


def require_class_or_real(target: Target, by: str) -> None:
    """Require a target of classes or real numbers.

    Raises:
        ConfigError: the target is an angle or an image.
    """
    if target.kind not in ("class", "real"):
        raise ConfigError(
            f"{by} describes targets of kind 'class' or 'real', but this data set's are {target.kind!r} "
            f"({target.listed_names}). Choose another density_head, or other data."
        )


def require_fitted(raw: Float[Tensor, "*batch size"], size: int, by: str) -> Float[Tensor, "*batch size"]:
    """Return `raw`, with half precision converted to float32.

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
    """Return the features on the CPU in float32, the type in which trees compare, clamped to its range."""
    most = torch.finfo(torch.float32).max
    return features.detach().clamp(-most, most).to("cpu", torch.float32).contiguous()


def with_gradient_of_0(
    numbers: Float[Tensor, "*batch_and_more"], raw: Float[Tensor, "*batch size"]
) -> Float[Tensor, "*batch_and_more"]:
    """Return `numbers` with a gradient of 0 in `raw`.

    The output of trees is piecewise constant in `raw`. The framework asks for a gradient as of any head; it is 0.
    """
    if not raw.requires_grad:
        return numbers
    zero = (raw * 0).sum(-1)
    return numbers + zero.reshape(*zero.shape, *(1,) * (numbers.dim() - zero.dim()))


Arrays = Mapping[str, np.ndarray]


def load_any_shape(
    head: nn.Module, require: Callable[[Any, Arrays], None], then: Callable[[Any, Any], None]
) -> None:
    """Let `load_state_dict` give the head's own buffers the shapes of the state, and call `then` afterwards.

    A state comes from an untrusted source: nothing of its arrays is used before `require` has checked them all.

    Args:
        head: the module whose buffers take the shapes of a state.
        require: receives the head and the arrays that it would have, with the dtypes of its buffers; raises a
            ValueError with a clause that says what is wrong if they do not fit.
        then: receives the head and torch's lists of missing and unexpected keys; reads what was loaded.
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
    """Replace buffers by ones with the state's shapes, and their own dtype and device; torch copies the numbers later.

    Raises:
        CheckpointError: the state is not one of such a head.
    """
    own = dict(head.named_buffers(recurse=False))
    stored = {name: state.get(prefix + name, buffer) for name, buffer in own.items()}
    try:
        require(head, {name: _array(name, stored[name], buffer) for name, buffer in own.items()})
    except ValueError as error:
        raise CheckpointError(
            f"The state of {type(head).__name__} is damaged: {shorten(error)}. Load another checkpoint, or train anew."
        ) from None
    for name, buffer in own.items():
        setattr(head, name, torch.empty(stored[name].shape, dtype=buffer.dtype, device=buffer.device))


def _array(name: str, found: Any, buffer: Tensor) -> np.ndarray:
    """Return the array that a buffer will hold; the width of floating-point numbers may differ, as in a cast model."""
    if not isinstance(found, Tensor) or found.layout != torch.strided or found.is_quantized:
        raise ValueError(f"{name} is no array of numbers")
    if found.dtype != buffer.dtype and not (found.is_floating_point() and buffer.is_floating_point()):
        raise ValueError(f"{name} holds numbers of type {found.dtype}; wanted {buffer.dtype}")
    found = found.detach().to("cpu", buffer.dtype)
    return (found.float() if found.dtype == torch.bfloat16 else found).numpy()  # NumPy has no bfloat16
