"""Check of an encoder's gradients in its parameters."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from framework.encoder import Encoder
from framework.testing.finding import SEED, Worst, seed

Make = Callable[[], Encoder]
Inputs = Callable[[int], Tensor]
GROUPS = 24
"""Number of groups of parameters; the parameters of a group are changed together."""
SLOW_GROUPS = 2
"""Number of groups for a slow encoder."""
STEPS = (1e-8, 1e-10, 1e-6)
"""Step lengths: a smaller step crosses fewer kinks of activations, a larger one loses fewer digits to rounding."""
CLOSE = 1e-3
"""Relative error below which no further step is tried."""
REPEATED = 4099
"""Period of the random numbers in a direction; it is prime, so that it is not the width of a layer."""
LARGEST = 30.0
"""Largest factor by which a parameter with a small gradient is changed more than others."""


def check_parameter_gradients(make: Make, inputs: Inputs, worst: Worst, *, slow: bool) -> None:
    """Compare directional derivatives in groups of parameters with central differences, in float64.

    The derivatives are of a loss that depends on all features. The error is relative to the norm of the gradient. Of
    several step lengths, the one with the smallest error counts, since no step agrees with a wrong gradient. The check
    runs in evaluation mode and, unless the encoder is slow, in training mode. In training, batch norm over few samples
    makes the loss of a slow, deep network too nonlinear for differences.

    Args:
        make: Function that returns a new encoder.
        inputs: Function from a number of samples to inputs of the encoder.
        worst: Recorder of the largest error.
        slow: True if the encoder is slow; fewer groups of parameters are then checked.
    """
    for training, count in ((False, 2),) if slow else ((True, 6), (False, 3)):
        encoder = make().double().train(training)
        perturb_parameters(encoder)  # activations without bias are at their kink, 0, for empty inputs
        _check_groups(encoder, inputs(count).double(), worst, slow=slow)


def perturb_parameters(encoder: Encoder) -> None:
    """Add small random numbers to the parameters, as after some training, so that none is 0."""
    generator = torch.Generator().manual_seed(SEED)
    with torch.no_grad():
        for value in encoder.parameters():
            value.add_(_noise(value, generator), alpha=0.01)


def _check_groups(encoder: Encoder, batch: Tensor, worst: Worst, *, slow: bool) -> None:
    named = [(name, value) for name, value in encoder.named_parameters() if value.requires_grad]
    worst.count(False, "the encoder has no parameters")
    if not named:
        return
    generator = torch.Generator().manual_seed(SEED)
    weight = torch.randn(len(batch), *encoder.output_shape, dtype=torch.float64, generator=generator)

    state = {name: value.clone() for name, value in encoder.named_buffers()}

    def total() -> Tensor:
        """Return the loss, with the same running moments and the same dropout mask at each call."""
        seed(SEED)
        for name, value in encoder.named_buffers():
            value.copy_(state[name])
        features = encoder(batch)
        return (weight * features + features.square()).mean()

    optional = torch.autograd.grad(total(), [value for _, value in named], allow_unused=True)
    gradients = [
        torch.zeros_like(value) if gradient is None else gradient
        for gradient, (_, value) in zip(optional, named, strict=True)
    ]
    largest = max(gradient.norm().item() for gradient in gradients)
    groups = min(SLOW_GROUPS if slow else GROUPS, len(named))
    for group in range(groups):
        part = range(group, len(named), groups)
        values = [named[index][1] for index in part]
        sizes = [gradients[index].norm().item() for index in part]
        largest_of_group = max(sizes)
        factors = [min(LARGEST, largest_of_group / max(size, 1e-300)) for size in sizes]
        scaled_norm = math.hypot(*(factor * size for factor, size in zip(factors, sizes, strict=True)))
        floor = max(scaled_norm, 1e-6 * largest, 1e-300)
        names = ", ".join(named[index][0] for index in part[:3]) + ", ..." * (len(part) > 3)
        where = "training" if encoder.training else "evaluation"
        description, error = "", float("inf")
        for step in STEPS:
            directions = [
                factor * _noise(value, generator) for factor, value in zip(factors, values, strict=True)
            ]
            parts = zip(part, directions, strict=True)
            analytic = sum((gradients[index] * direction).sum().item() for index, direction in parts)
            ends = _losses_at_ends(values, directions, step, total)
            numeric = (ends[0] - ends[1]) / (2 * step)
            error = min(error, abs(analytic - numeric) / floor)
            description = f"{names}, in {where} mode: {analytic:.6g}, by differences {numeric:.6g}"
            if error < CLOSE:
                break
        worst.record(error, description)


def _noise(like: Tensor, generator: torch.Generator) -> Tensor:
    """Return normal random numbers with shape and dtype of `like`, which repeat with the period REPEATED."""
    numbers = torch.randn(min(like.numel(), REPEATED), dtype=like.dtype, generator=generator)
    return numbers.repeat(-(-like.numel() // len(numbers)))[: like.numel()].view(like.shape)


def _losses_at_ends(
    values: Sequence[Tensor], directions: Sequence[Tensor], step: float, total: Callable[[], Tensor]
) -> list[float]:
    """Return the losses after a step forwards and after one backwards in the parameters, which are then restored."""
    losses = []
    with torch.no_grad():
        for change in (step, -2 * step, step):  # the last change restores the parameters, up to rounding
            for value, direction in zip(values, directions, strict=True):
                value.add_(direction, alpha=change)
            if len(losses) < 2:
                losses.append(total().item())
    return losses
