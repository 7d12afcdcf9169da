"""Evaluation of large tensors by compiled code; torch operations are used where compiled code does not apply."""

import numpy as np
import torch
from torch import Tensor

FEWEST = 4096
"""Smallest number of elements that are computed by compiled code if gradients are needed, as in each training step."""
FEWEST_ONCE = 2**18
"""Smallest number of elements, or of samples to draw, for which compiled code is used if no gradient is needed.

With fewer elements, a few evaluations would save less time than the half second that the import of numba takes.
"""

CPU = torch.device("cpu")


def is_transformed() -> bool:
    """Return whether a transform of torch.func is active, so that no number may be read from a tensor."""
    return torch._C._functorch.peek_interpreter_stack() is not None  # pyright: ignore[reportAttributeAccessIssue]


def applies(*arguments: Tensor) -> bool:
    """Return whether compiled code can read these arguments: ordinary tensors on the CPU.

    Tensors in compiled or exported programs and in transforms of torch.func have no data that compiled code could read.
    """
    return (
        not torch.compiler.is_compiling()
        and not torch.compiler.is_exporting()
        and not torch.jit.is_tracing()
        and not is_transformed()
        and all(type(argument) in (Tensor, torch.nn.Parameter) for argument in arguments)
        and all(argument.device == CPU and not argument.is_neg() for argument in arguments)
    )


def empty(count: int, shape: torch.Size, dtype: torch.dtype) -> list[Tensor]:
    """Return `count` uninitialised tensors.

    They share one piece of memory from NumPy, which asks the system for large pages. For a million elements, providing
    ordinary pages, as torch requests them, would take the system as long as the computation itself.
    """
    parts = np.empty((count, shape.numel()), dtype=str(dtype).removeprefix("torch."))
    return [torch.from_numpy(part).view(shape) for part in parts]


def multiply(factor: Tensor, *tensors: Tensor) -> list[Tensor]:
    """Return the product of `factor` and each of the tensors, which have its shape and dtype."""
    # with gradients enabled, they are recorded for second derivatives
    if torch.is_grad_enabled() or not applies(factor, *tensors) or factor.numel() < FEWEST:
        return [factor * tensor for tensor in tensors]
    products = empty(len(tensors), factor.shape, factor.dtype)
    return [torch.mul(factor, tensor, out=product) for tensor, product in zip(tensors, products, strict=True)]


def density(value: Tensor, mean: Tensor, concentration: Tensor, *, slopes: bool) -> tuple[Tensor, ...] | None:
    """Return log p; with `slopes`, also its derivatives with respect to the mean and to κ; without gradients.

    The arguments are broadcast and have one dtype. If compiled code does not apply, if there are too few elements, or
    if a difference of angles is too large for compiled code, the function returns None.
    """
    # first, because an exported program must not depend on the size of a batch
    if not applies(value, mean, concentration) or value.dtype not in (torch.float32, torch.float64):
        return None
    shape = value.shape
    if mean.shape != shape or concentration.shape != shape:
        # torch.broadcast_shapes would import SymPy
        shape = torch.broadcast_tensors(value, mean, concentration)[0].shape
    if shape.numel() < (FEWEST if slopes else FEWEST_ONCE):
        return None
    from plugins.density_head.von_mises import compiled

    results = tuple(empty(3 if slopes else 1, shape, value.dtype))
    function = compiled.log_prob_and_slopes if slopes else compiled.log_prob
    arrays = (
        tensor.detach().expand(shape).reshape(-1).numpy() for tensor in (value, mean, concentration, *results)
    )
    return None if function(*arrays) else results


def sample(mean: Tensor, concentration: Tensor, block: int, rounds: int) -> Tensor | None:
    """Return one angle in [-π, π] per element, as `functions.sample` does; None if compiled code does not apply.

    Random numbers are drawn in the same order as by torch operations, so that samples agree up to rounding.

    Args:
        mean: μ, radians.
        concentration: κ, of the same shape.
        block: number of elements that are processed together.
        rounds: largest number of proposals for an element.
    """
    if not applies(mean, concentration) or mean.numel() < FEWEST_ONCE:
        return None
    from plugins.density_head.von_mises import compiled

    (angle,) = empty(1, mean.shape, torch.float64)
    size = min(block, mean.numel())
    scale, floor, proposed, excess, half_tangent = np.empty((5, size))
    lanes = np.empty(size, np.int64)
    parts = zip(*(tensor.reshape(-1).split(block) for tensor in (mean, concentration, angle)), strict=True)
    for some_mean, some_concentration, some_angle in parts:
        kappa = some_concentration.to(torch.float64, copy=True).numpy()
        compiled.set_up(kappa, scale, floor, lanes)
        count = len(kappa)
        for _ in range(rounds):
            uniform, accept = torch.rand(2, count, dtype=torch.float64, device="cpu").numpy()
            count = compiled.propose(
                kappa, scale, floor, lanes, uniform, accept, proposed, excess, half_tangent
            )
            if count == 0:
                break
        compiled.turn(half_tangent, some_mean.double().numpy(), some_angle.numpy())
    return angle.to(mean.dtype)
