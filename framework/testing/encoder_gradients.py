"""Checks of an encoder's gradients; each reports its worst case."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from framework.encoder import Encoder
from framework.testing.finding import SEED, Worst, seed

Make = Callable[[], Encoder]
Inputs = Callable[[int], Tensor]
GROUPS = 24
"""Number of groups of parameters; the parameters of a group are moved at once. A slow encoder has SLOW_GROUPS."""
SLOW_GROUPS = 2
STEPS = (1e-8, 1e-10, 1e-6)
"""Step lengths: a smaller step reaches fewer kinks of the units, a larger one loses less to rounding."""
CLOSE = 1e-3
REPEATED = 4099
"""Prime number that is not the width of any layer."""
LARGEST = 30.0
"""Largest factor by which a parameter of small gradient is moved farther than others."""


def of_weights(make: Make, inputs: Inputs, worst: Worst, *, slow: bool) -> None:
    """Check directional derivatives of a sum over the features in groups of parameters, in float64.

    The error is relative to the gradient's size. The step that agrees best counts, since no step agrees with a wrong
    gradient. The check runs in evaluation mode, and in training mode where the encoder is not slow. Batch norm over few
    samples makes the loss of a slow, deep network too nonlinear in training.
    """
    for training, count in ((False, 2),) if slow else ((True, 6), (False, 3)):
        encoder = make().double().train(training)
        moved_a_little(encoder)  # units without offset have a kink at 0, which is their value on empty inputs
        _of_weights(encoder, inputs(count).double(), worst, slow=slow)


def moved_a_little(encoder: Encoder) -> None:
    """Move the encoder's parameters a little, as after some training, so that none is 0."""
    generator = torch.Generator().manual_seed(SEED)
    with torch.no_grad():
        for value in encoder.parameters():
            value.add_(0.01 * torch.randn(value.shape, dtype=value.dtype, generator=generator))


def _of_weights(encoder: Encoder, batch: Tensor, worst: Worst, *, slow: bool) -> None:
    named = [(name, value) for name, value in encoder.named_parameters() if value.requires_grad]
    worst.count(False, "no parameters")
    if not named:
        return
    generator = torch.Generator().manual_seed(SEED)
    weight = torch.randn(len(batch), *encoder.output_shape, dtype=torch.float64, generator=generator)

    state = {name: value.clone() for name, value in encoder.named_buffers()}

    def total() -> Tensor:
        """Return the loss with the same running moments and the same dropout mask at each call."""
        seed(SEED)
        for name, value in encoder.named_buffers():
            value.copy_(state[name])
        found = encoder(batch)
        return (weight * found + found.square()).mean()

    found = torch.autograd.grad(total(), [value for _, value in named], allow_unused=True)
    gradients = [
        torch.zeros_like(value) if one is None else one for one, (_, value) in zip(found, named, strict=True)
    ]
    largest = max(one.norm().item() for one in gradients)
    groups = min(SLOW_GROUPS if slow else GROUPS, len(named))
    for group in range(groups):
        part = range(group, len(named), groups)
        values = [named[index][1] for index in part]
        sizes = [gradients[index].norm().item() for index in part]
        longest = max(sizes)
        factors = [min(LARGEST, longest / max(size, 1e-300)) for size in sizes]
        moved = math.hypot(*(factor * size for factor, size in zip(factors, sizes, strict=True)))
        floor = max(moved, 1e-6 * largest, 1e-300)
        names = ", ".join(named[index][0] for index in part[:3]) + ", ..." * (len(part) > 3)
        where = "training" if encoder.training else "evaluation"
        told, error = "", float("inf")
        for step in STEPS:
            way = [factor * _noise(value, generator) for factor, value in zip(factors, values, strict=True)]
            parts = zip(part, way, strict=True)
            analytic = sum((gradients[index] * one).sum().item() for index, one in parts)
            numeric = (_moved(values, way, step, total) - _moved(values, way, -step, total)) / (2 * step)
            error = min(error, abs(analytic - numeric) / floor)
            told = f"{names}, in {where}: {analytic:.6g}, by differences {numeric:.6g}"
            if error < CLOSE:
                break
        worst.see(error, told)


def _noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Return normal numbers, which repeat every REPEATED numbers."""
    numbers = torch.randn(min(like.numel(), REPEATED), dtype=torch.float64, generator=generator)
    return numbers.repeat(-(-like.numel() // len(numbers)))[: like.numel()].view(like.shape)


def _moved(
    values: Sequence[Tensor], way: Sequence[Tensor], step: float, total: Callable[[], Tensor]
) -> float:
    """Return the loss at moved parameters; they are moved back afterwards, up to rounding."""
    with torch.no_grad():
        for value, one in zip(values, way, strict=True):
            value.add_(one, alpha=step)
        found = total().item()
        for value, one in zip(values, way, strict=True):
            value.sub_(one, alpha=step)
    return found
