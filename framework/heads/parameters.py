"""Checks of the raw parameters that a density head reads or is fitted to, and of a mixture's component."""

import math

import torch
from torch import Tensor

from framework.density_head import DensityHead
from framework.errors import ConfigError, NonFiniteParameters


def require_finite(raw: Tensor, shape: int | tuple[int, ...]) -> Tensor:
    """Return `raw` (*batch, *shape) if it is finite, half precision upcast to float32.

    Args:
        raw: raw parameters.
        shape: `raw_shape` of the head; a number means a vector of this size.

    Raises:
        ValueError: the last dimensions are not `shape`.
        NonFiniteParameters: a number is not finite. This error is also a ValueError, and its message names the first
            such row of the batch.
    """
    own = (shape,) if isinstance(shape, int) else shape
    if raw.shape[-len(own) :] != own:
        last = f"{own[0]} in the last dimension" if len(own) == 1 else f"{own} in the last dimensions"
        raise ValueError(f"Got raw parameters of shape {tuple(raw.shape)}; expected {last}.")
    # If the sum is finite, so is every number. This takes one pass; heads of very many numbers notice a second one.
    # An exported program checks its inputs instead, because a trace cannot depend on values.
    if (
        not torch.compiler.is_exporting()
        and not math.isfinite(float(raw.detach().sum()))
        and not raw.isfinite().all()
    ):
        row = tuple((~raw.isfinite().flatten(-len(own)).all(-1)).nonzero()[0].tolist())
        raise NonFiniteParameters(
            f"The raw parameters are not finite in batch row {row[0] if len(row) == 1 else row}; expected finite "
            "numbers. Check the inputs of this row."
        )
    return raw.float() if raw.dtype in (torch.float16, torch.bfloat16) else raw


def require_validation(raw: Tensor, fitted: str) -> None:
    """Check that `calibrate` got samples.

    Args:
        raw: raw parameters of the validation split, (sample, size).
        fitted: subject and verb of the message, such as "A fixed covariance is".

    Raises:
        ValueError: the split is empty.
    """
    if len(raw) == 0:
        raise ValueError(
            f"{fitted} fitted to the validation split, but this split is empty. Use data with a validation split."
        )


def require_trained(component: DensityHead) -> DensityHead:
    """Return the component itself if all its parameters are trained by gradient.

    Raises:
        ConfigError: the component fits parameters after training, but it cannot know which samples belong to it. Or the
            component requires backbones (separate networks for its parts), which only the head of a model has. Or
            the component reads an image.
    """
    if len(component.raw_shape) != 1:
        raise ConfigError(
            f"density_head.component reads raw parameters of shape {component.raw_shape}, but a component must read a "
            "vector. Choose another component."
        )
    if component.backbones:
        raise ConfigError(
            "density_head.component requires separate networks for its parts, but only the head of a model has "
            "networks. Leave density_head.component.backbones at shared."
        )
    fitted = set(component.state_dict()) - {name for name, _ in component.named_parameters()}
    if fitted:
        raise ConfigError(
            f"density_head.component fits {', '.join(sorted(fitted))} after training, but only the head "
            "of a model can be fitted then. Let the component predict these parameters, as von_mises does with "
            "density_head.component.concentration=predicted."
        )
    return component
