"""Checks of the gradients of a head's loss: finite differences, and a mean of zero over draws from the density.

The argument `subject` of a check is the head under test (`framework.testing.head_subject.HeadSubject`). Errors are
recorded in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from framework.testing.finding import SEED, Worst, seed
from framework.testing.head_subject import HeadSubject, as_type, seeded

STEPS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
"""Step lengths of central differences, multiplied by the size of raw parameters if that is above 1.

The last three steps are used only if the differences with the first three all disagree with the derivative.
"""


def gradient(subject: HeadSubject, worst: Worst) -> None:
    """Check derivatives of the loss in each raw parameter, and along a direction in the head's parameters.

    The derivatives are compared with central differences for each item of the batch, at random targets and at draws. Of
    three step lengths, the one with the smallest error counts, since a small step suffers from rounding and a large one
    may cross a kink. If all three disagree, three smaller steps follow, which resolve a narrow density. A derivative
    then also passes if it agrees with the least uncertain of the six differences (`most_certain`), or with a one-sided
    difference of one of the first three steps, since the loss may have a kink at the target.
    """
    head = subject.make().double().train()
    for size in (0.1, 1.0, 3.0, 30.0, 1e3):
        # not the features to which trees were fitted, since trees jump there
        raw = (1.013 * size * subject.raw_parameters(8).double()).flatten(1).requires_grad_()
        value = as_type(subject.values(8), torch.float64)
        with torch.no_grad():
            # at large raw parameters, a draw of several reals may be rounded by more than the width of the density
            if subject.row.target.kind != "real" or size <= 30:
                value[4:] = seeded(head, raw[4:].view(4, *subject.raw_shape)).sample()

        def loss(raw: Tensor = raw, value: Tensor = value) -> Tensor:
            seed(SEED)
            return head.loss(raw.view(8, *subject.raw_shape), value)

        arguments = {"raw parameters": raw}
        if size <= 3:
            arguments.update((name, part) for name, part in head.named_parameters() if part.requires_grad)
        gradients = torch.autograd.grad(loss().sum(), list(arguments.values()), allow_unused=True)
        for number, ((name, argument), slopes) in enumerate(zip(arguments.items(), gradients, strict=True)):
            slopes = torch.zeros_like(argument) if slopes is None else slopes
            for column, direction in _directions(argument, name == "raw parameters", size, number):
                slope = slopes * direction
                analytic = slope.sum(-1) if name == "raw parameters" else slope.sum()
                least = 1e-3 * slopes.norm(dim=-1) if name == "raw parameters" else 1.0

                difference_at = partial(difference, loss, argument, direction, whole=name != "raw parameters")
                steps = [max(1.0, size) * step for step in STEPS]
                differences = [difference_at(step) for step in steps[:3]]
                errors = [candidate.error(analytic, least) for candidate in differences]
                error = torch.stack(errors).amin(0)
                if bool((error > 1e-7).any()):
                    # The density is narrower than the steps, or a kink lies within them, so smaller steps are tried.
                    differences += [difference_at(step) for step in steps[3:]]
                    error = torch.minimum(error, most_certain(differences).error(analytic, least))
                    for candidate in differences[:3]:  # smaller steps have too much rounding to show a kink
                        error = torch.minimum(error, candidate.error_at_kink(analytic, least))
                numeric = most_certain(differences).slope
                # differences of large losses have fewer correct digits
                worst.record(
                    error * (1.0 if size <= 3 else 1e-3),
                    lambda at, name=name, size=size, column=column, analytic=analytic, numeric=numeric: (
                        f"derivative in {name}{column} of size {size:g}, row {at}: {analytic[at].item():.9g}, "
                        f"by differences {numeric[at].item():.9g}"
                    ),
                )


class Difference(NamedTuple):
    """Central difference of a loss, with a bound on its rounding error.

    Attributes:
        slope: Estimate of the derivative.
        noise: Bound on the error of `slope` from rounding.
        sides: One-sided differences, to the left and to the right of the point, (2, ...).
    """

    slope: Tensor
    noise: Tensor
    sides: Tensor

    def error(self, analytic: Tensor, least: Tensor | float) -> Tensor:
        """Return the part of |analytic - slope| that exceeds the noise, relative to the slope.

        Args:
            analytic: Derivative to compare with the slope.
            least: Smallest divisor: the error is divided by the largest of |slope|, this number and 1e-3.
        """
        scale = self.slope.abs().clamp(min=1e-3).maximum(torch.as_tensor(least))
        return ((analytic - self.slope).abs() - self.noise).clamp(min=0) / scale

    def error_at_kink(self, analytic: Tensor, least: Tensor | float) -> Tensor:
        """Return the error of a derivative as `error` does, but from the nearer one of the two one-sided differences.

        The error is relative to this one-sided difference. For a loss without a kink, both one-sided differences are
        close to the slope.

        Args:
            analytic: Derivative to compare with the one-sided differences.
            least: Smallest divisor, as in `error`.
        """
        scale = self.sides.abs().clamp(min=1e-3).maximum(torch.as_tensor(least))
        return (((analytic - self.sides).abs() - 2 * self.noise).clamp(min=0) / scale).amin(0)


@torch.no_grad()
def difference(
    loss: Callable[[], Tensor], argument: Tensor, direction: Tensor, step: float, whole: bool
) -> Difference:
    """Return the central difference of a loss along a direction.

    Args:
        loss: Function that returns the loss of each item of the batch.
        argument: Tensor on which the loss depends; it is changed in place during the call, and restored.
        direction: Direction in which `argument` is changed.
        step: Step length.
        whole: If true, return the difference of the sum of all losses, otherwise of each loss.
    """
    ends = []
    for sign in (1, -1, 0):
        argument += sign * step * direction
        ends.append(loss())
        argument -= sign * step * direction
    if whole:
        ends = [end.sum() for end in ends]
    sides = torch.stack([ends[2] - ends[1], ends[0] - ends[2]]) / step
    # bound on the effect of rounding in the two losses and in the quantities from which they are computed
    noise = 16 * torch.finfo(torch.float64).eps * ends[0].abs() / step
    return Difference((ends[0] - ends[1]) / (2 * step), noise, sides)


def most_certain(differences: Sequence[Difference]) -> Difference:
    """Return, for each item of the batch, the finite difference that is least uncertain.

    The uncertainty of a finite difference is the distance of its slope from the slope with the previous step length,
    plus its bound on the rounding error.

    Args:
        differences: At least two finite differences of the same losses, each with another step length. The first one
            only serves for comparison with the second.
    """
    slope = torch.stack([candidate.slope for candidate in differences])
    noise = torch.stack([candidate.noise for candidate in differences])
    sides = torch.stack([candidate.sides for candidate in differences])
    doubt = (slope[1:] - slope[:-1]).abs() + noise[1:]
    best = doubt.nan_to_num(nan=math.inf).argmin(0, keepdim=True)
    both = best.unsqueeze(1).expand(1, *sides.shape[1:])
    return Difference(
        slope[1:].gather(0, best)[0], noise[1:].gather(0, best)[0], sides[1:].gather(0, both)[0]
    )


def _directions(argument: Tensor, raw: bool, size: float, number: int) -> Iterator[tuple[str, Tensor]]:
    """Yield names and directions: a random direction, and each axis if there are few raw parameters.

    Args:
        argument: Tensor in which derivatives are taken.
        raw: True for raw parameters, whose last dimension is the direction of each item of the batch.
        size: Size of the raw parameters; at large sizes there is no random direction.
        number: Number that selects the seed.
    """
    generator = torch.Generator().manual_seed(number)
    direction = torch.randn(argument.shape, dtype=argument.dtype, generator=generator)
    if size <= 3:  # large parameters act on very different scales, so that they are not changed together
        yield "", direction / (direction.norm(dim=-1, keepdim=True) if raw else direction.norm())
    for column in range(argument.shape[-1] if raw and argument.shape[-1] <= 12 else 0):
        yield (
            f" [{column}]",
            torch.eye(argument.shape[-1], dtype=argument.dtype)[column].expand_as(argument),
        )


def mean_gradient_is_zero(subject: HeadSubject, worst: Worst) -> None:
    """Check that the mean gradient of the loss over draws from the density is 0; the error is in standard errors.

    The mean is 0 for every proper score (Gneiting & Raftery 2007). The standard error includes a term for values that
    are too rare to occur among the draws.
    """
    if subject.draws():
        worst.count(False, "log_prob draws random numbers, so the loss may be a bound on it")
        return
    head, draws = subject.make().double(), 1000 if len(subject.row.target.names) > 2 else 4000
    for size in (0.3, 3.0, 30.0):
        raw = size * subject.raw_parameters(3).double()
        raw = raw.expand(draws, *raw.shape).clone().requires_grad_()
        with torch.no_grad():
            value = head.eval()(raw[0]).sample(torch.Size((draws,)))
        # gradients at random targets show how large the gradient at values that were not drawn may be
        value[:32] = as_type(subject.values(32, 3), torch.float64)
        (gradient,) = torch.autograd.grad(head.train().loss(raw, value).sum(), raw, allow_unused=True)
        if gradient is None:
            worst.record(math.inf, "the loss does not depend on the raw parameters")
            return
        gradient = gradient.flatten(2)
        rare = 2 * gradient.abs().amax((0, 2)).unsqueeze(-1) / draws
        gradient = gradient[32:]
        noise = gradient.std(0) / draws**0.5 + rare + 1e-12
        worst.record(
            gradient.mean(0).abs() / noise,
            lambda at, size=size: (
                f"mean gradient in raw parameter {at[1]} of size {size:g}, batch row {at[0]}"
            ),
        )
