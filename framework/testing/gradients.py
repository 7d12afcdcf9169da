"""Gradients of a head's loss: against finite differences, and nothing to gain by leaving the truth."""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from framework.testing.finding import SEED, Worst, seed
from framework.testing.heads import HeadSubject, as_type, seeded


def gradient(subject: HeadSubject, worst: Worst) -> None:
    """Derivatives of the loss in every raw number, and along one direction in parameters, against central differences.

    Each row by itself, at random targets and at draws; of three steps the one that agrees best, as the smallest is
    lost in rounding and the largest may reach across a kink.
    """
    head = subject.make().double().train()
    for size in (0.1, 1.0, 3.0, 30.0, 1e3):
        # not the very numbers to which trees were fitted: they jump there
        raw = (1.013 * size * subject.raws(8).double()).requires_grad_()
        value = as_type(subject.values(8), torch.float64)
        with torch.no_grad():
            # far out, a draw of several reals may be rounded by more than the narrowest of them is wide
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
                errors, numeric = [], analytic
                for step in (1e-4, 1e-5, 1e-6):
                    step = step * max(1.0, size)
                    ends = []
                    with torch.no_grad():
                        for sign in (1, -1):
                            argument += sign * step * direction
                            ends.append(loss())
                            argument -= sign * step * direction
                        if name != "raw numbers":
                            ends = [end.sum() for end in ends]
                    numeric = (ends[0] - ends[1]) / (2 * step)
                    # what rounding of the two losses, and of raw numbers on the way, does to their difference
                    noise = 16 * torch.finfo(torch.float64).eps * ends[0].abs() / step
                    least = 1e-3 * slopes.norm(dim=-1) if name == "raw numbers" else 1.0
                    scale = numeric.abs().clamp(min=1e-3).maximum(torch.as_tensor(least))
                    errors.append(((analytic - numeric).abs() - noise).clamp(min=0) / scale)
                # differences of large losses know fewer digits
                worst.see(
                    torch.stack(errors).amin(0) * (1.0 if size <= 3 else 1e-3),
                    lambda at, name=name, size=size, column=column, analytic=analytic, numeric=numeric: (
                        f"in {name}{column} of size {size:g}, row {at}: {analytic[at].item():.9g}, "
                        f"by differences {numeric[at].item():.9g}"
                    ),
                )


def _directions(argument: Tensor, raw: bool, size: float, number: int) -> Iterator[tuple[str, Tensor]]:
    """A random direction of length 1, and of few raw numbers each by itself."""
    generator = torch.Generator().manual_seed(number)
    direction = torch.randn(argument.shape, dtype=argument.dtype, generator=generator)
    if size <= 3:  # far out, numbers of very different reach are not stepped along together
        yield "", direction / (direction.norm(dim=-1, keepdim=True) if raw else direction.norm())
    for column in range(argument.shape[-1] if raw and argument.shape[-1] <= 12 else 0):
        yield (
            f" [{column}]",
            torch.eye(argument.shape[-1], dtype=argument.dtype)[column].expand_as(argument),
        )


def proper(subject: HeadSubject, worst: Worst) -> None:
    """The mean gradient of the loss over draws of the density is 0, as of any proper score (Gneiting & Raftery 2007);
    in standard errors, to which what may be too rare to be drawn adds."""
    if subject.draws():
        worst.count(False, "draws in log_prob, of which the loss may be a bound")
        return
    head, draws = subject.make().double(), 1000 if len(subject.row.target.names) > 2 else 4000
    for size in (0.3, 3.0, 30.0):
        raw = (size * subject.raws(3).double()).expand(draws, -1, -1).clone().requires_grad_()
        with torch.no_grad():
            value = head.eval()(raw[0]).sample(torch.Size((draws,)))
        # gradients elsewhere tell how large one may be that was not drawn
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
