"""Checks of the gradients of a head's loss: against finite differences, and zero on average over draws."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from framework.testing.finding import SEED, Worst, seed
from framework.testing.heads import HeadSubject, as_type, seeded

STEPS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
"""Steps of central differences, relative to distribution parameters above 1.

Steps after the third are used where none of the first three agrees with the derivative.
"""


def gradient(subject: HeadSubject, worst: Worst) -> None:
    """Check derivatives of the loss in each distribution parameter and along a direction in the head's parameters.

    They are compared with central differences, for each row alone, at random targets and at draws. Of three steps the
    one that agrees best counts, as the smallest may be lost in rounding and the largest may cross a kink. Where none of
    them agrees, smaller steps follow that resolve a narrow density: the difference that is closest to that of the step
    before counts, whatever the derivative is.
    """
    head = subject.make().double().train()
    for size in (0.1, 1.0, 3.0, 30.0, 1e3):
        # not the numbers to which trees were fitted, since trees jump there
        raw = (1.013 * size * subject.raws(8).double()).requires_grad_()
        value = as_type(subject.values(8), torch.float64)
        with torch.no_grad():
            # far out, a draw of several reals may be rounded by more than the width of the narrowest density
            if subject.row.target.kind != "real" or size <= 30:
                value[4:] = seeded(head, raw[4:]).sample()

        def loss(raw: Tensor = raw, value: Tensor = value) -> Tensor:
            seed(SEED)
            return head.loss(raw, value)

        arguments = {"raw numbers": raw}
        if size <= 3:
            arguments.update((name, part) for name, part in head.named_parameters() if part.requires_grad)
        gradients = torch.autograd.grad(loss().sum(), list(arguments.values()), allow_unused=True)
        for number, ((name, argument), slopes) in enumerate(zip(arguments.items(), gradients, strict=True)):
            slopes = torch.zeros_like(argument) if slopes is None else slopes
            for column, direction in _directions(argument, name == "raw numbers", size, number):
                slope = slopes * direction
                analytic = slope.sum(-1) if name == "raw numbers" else slope.sum()
                least = 1e-3 * slopes.norm(dim=-1) if name == "raw numbers" else 1.0

                at = partial(difference, loss, argument, direction, whole=name != "raw numbers")
                steps = [max(1.0, size) * step for step in STEPS]
                found = [at(step) for step in steps[:3]]
                errors = [one.error(analytic, least) for one in found]
                error = torch.stack(errors).amin(0)
                if bool((error > 1e-7).any()):
                    # The density is narrower than the steps, or a kink lies within them. Try smaller steps until
                    # two agree.
                    found += [at(step) for step in steps[3:]]
                    error = torch.minimum(error, most_certain(found).error(analytic, least))
                numeric = most_certain(found).slope
                # differences of large losses have fewer correct digits
                worst.see(
                    error * (1.0 if size <= 3 else 1e-3),
                    lambda at, name=name, size=size, column=column, analytic=analytic, numeric=numeric: (
                        f"in {name}{column} of size {size:g}, row {at}: {analytic[at].item():.9g}, "
                        f"by differences {numeric[at].item():.9g}"
                    ),
                )


class Difference(NamedTuple):
    """Central difference of a loss, and the bound on what rounding of the two losses adds to it."""

    slope: Tensor
    noise: Tensor

    def error(self, analytic: Tensor, least: Tensor | float) -> Tensor:
        """Return the error of a derivative beyond the noise, relative to the slope.

        The scale is at least `least` and 1e-3.
        """
        scale = self.slope.abs().clamp(min=1e-3).maximum(torch.as_tensor(least))
        return ((analytic - self.slope).abs() - self.noise).clamp(min=0) / scale


@torch.no_grad()
def difference(
    loss: Callable[[], Tensor], argument: Tensor, direction: Tensor, step: float, whole: bool
) -> Difference:
    """Return the central difference of each row's loss or, if `whole`, of their sum, along a direction."""
    ends = []
    for sign in (1, -1):
        argument += sign * step * direction
        ends.append(loss())
        argument -= sign * step * direction
    if whole:
        ends = [end.sum() for end in ends]
    # effect that rounding of the two losses, and of distribution parameters on the way, has on their difference
    noise = 16 * torch.finfo(torch.float64).eps * ends[0].abs() / step
    return Difference((ends[0] - ends[1]) / (2 * step), noise)


def most_certain(found: Sequence[Difference]) -> Difference:
    """Return for each row the difference that deviates least from the one before it, with its own noise added."""
    slope, noise = (torch.stack(parts) for parts in zip(*found, strict=True))
    doubt = (slope[1:] - slope[:-1]).abs() + noise[1:]
    best = doubt.nan_to_num(nan=math.inf).argmin(0, keepdim=True)
    return Difference(slope[1:].gather(0, best)[0], noise[1:].gather(0, best)[0])


def _directions(argument: Tensor, raw: bool, size: float, number: int) -> Iterator[tuple[str, Tensor]]:
    """Yield a random direction of length 1, and each axis where there are few distribution parameters."""
    generator = torch.Generator().manual_seed(number)
    direction = torch.randn(argument.shape, dtype=argument.dtype, generator=generator)
    if size <= 3:  # far out, parameters that act on very different scales are not changed together
        yield "", direction / (direction.norm(dim=-1, keepdim=True) if raw else direction.norm())
    for column in range(argument.shape[-1] if raw and argument.shape[-1] <= 12 else 0):
        yield (
            f" [{column}]",
            torch.eye(argument.shape[-1], dtype=argument.dtype)[column].expand_as(argument),
        )


def proper(subject: HeadSubject, worst: Worst) -> None:
    """Check that the mean gradient of the loss over draws of the density is 0, in standard errors.

    This holds for every proper score (Gneiting & Raftery 2007). The standard error includes a term for values too rare
    to be drawn.
    """
    if subject.draws():
        worst.count(False, "draws in log_prob, of which the loss may be a bound")
        return
    head, draws = subject.make().double(), 1000 if len(subject.row.target.names) > 2 else 4000
    for size in (0.3, 3.0, 30.0):
        raw = (size * subject.raws(3).double()).expand(draws, -1, -1).clone().requires_grad_()
        with torch.no_grad():
            value = head.eval()(raw[0]).sample(torch.Size((draws,)))
        # gradients at other targets show how large the gradient of a value may be that was not drawn
        value[:32] = as_type(subject.values(32, 3), torch.float64)
        (gradient,) = torch.autograd.grad(head.train().loss(raw, value).sum(), raw, allow_unused=True)
        if gradient is None:
            worst.see(math.inf, "the loss does not depend on the raw numbers")
            return
        rare = 2 * gradient.abs().amax((0, 2)).unsqueeze(-1) / draws
        gradient = gradient[32:]
        noise = gradient.std(0) / draws**0.5 + rare + 1e-12
        worst.see(
            gradient.mean(0).abs() / noise,
            lambda at, size=size: f"raw number {at[1]} of size {size:g}, batch row {at[0]}",
        )
