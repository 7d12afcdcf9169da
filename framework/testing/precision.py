"""Checks of the accuracy of a head's log-densities: the row's reference cases, and float32 compared with float64.

The argument `subject` of a check is the head under test (`framework.testing.head_subject.HeadSubject`). Errors are
recorded in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

import copy
import math

import torch
from torch import Tensor

from framework.density_head import DensityHead
from framework.distributions.circular import Circular, wrap
from framework.distributions.protocol import mode_candidates
from framework.testing.finding import Worst
from framework.testing.head_subject import HeadSubject, as_type, seeded

LIMIT = 32.0
"""Largest error of float32 log-densities that passes, in float32 epsilons."""
JUMP = 4
"""Number of float32 epsilons within which the place of a jump or of a narrow peak of log p is not known."""


def reference(subject: HeadSubject, worst: Worst, dtype: torch.dtype) -> None:
    """Compare log_prob with the row's reference cases; the error is relative to max(1, |reference|).

    Conversion to `dtype` rounds each parameter of the head. The change of log_prob by this rounding, to first order, is
    not counted as an error. The inputs of the cases are exact in every dtype.
    """
    assert subject.row.cases is not None
    head = subject.make().double()
    cases = list(subject.row.cases(head))
    change = [torch.zeros_like(case.log_prob) for case in cases]
    if dtype != torch.float64 and any(part.requires_grad for part in head.parameters()):
        change = [rounding_change(subject, head, case.raw, case.value, parameters=True)[1] for case in cases]
    head = head.to(dtype)
    for case, allowed in zip(cases, change, strict=True):
        with torch.no_grad():
            log_prob = seeded(head, case.raw.to(dtype)).log_prob(as_type(case.value, dtype)).double()
        gap = (log_prob - case.log_prob).abs() - torch.finfo(dtype).eps * allowed
        error = gap.clamp(min=0) / case.log_prob.abs().clamp(min=1)
        worst.record(
            error,
            lambda at, case=case, log_prob=log_prob: (
                f"{case.name}: {log_prob[at].item():.9g}, reference {case.log_prob[at].item():.9g}"
            ),
        )


def precision(subject: HeadSubject, worst: Worst) -> None:
    """Compare log_prob in float32 with float64 for the same head and inputs; the error is in float32 epsilons.

    The error is relative to max(1, |log p|) plus the change of log p from rounding the raw parameters and the value. So
    a large error comes from cancellation inside the head. For a head with parameters of its own, the change from
    rounding these parameters is added where the error is large.

    The change to first order is not enough where log p jumps, as at the border of a cell in which the density is
    constant, or where a component of a mixture is narrower than the rounding of its place. There, any number between
    the smallest and the largest float64 log-density within a few float32 epsilons of the value is a right result.
    """
    single = subject.make()
    double = copy.deepcopy(single).double()
    for size in (1e-8, 1e-3, 1.0, 10.0, 1e2, 1e3, 1e4, 1e6):
        raw = size * subject.raw_parameters(64)
        with torch.no_grad():
            at_mode = seeded(single, raw).mode
        for where, value in (("the mode", at_mode), ("a random value", subject.values(64))):
            with torch.no_grad():
                log_prob = seeded(single, raw).log_prob(value).double()
            exact, change = rounding_change(subject, double, raw.double(), value)
            scale = exact.abs().clamp(min=1) + change
            error = (log_prob - exact).abs() / scale / torch.finfo(torch.float32).eps
            bad = error > LIMIT
            if bad.any() and any(part.requires_grad for part in double.parameters()):
                # rounding inside a network changes log p as rounding of its parameters does
                change = change.clone()
                rows = bad.nonzero()[:, 0]
                change[rows] = rounding_change(
                    subject, double, raw.double()[rows], value[rows], parameters=True
                )[1]
                scale = exact.abs().clamp(min=1) + change
                error = (log_prob - exact).abs() / scale / torch.finfo(torch.float32).eps
            if (error > LIMIT).any() and value.is_floating_point():
                near = _log_prob_near(subject, double, raw.double(), value)
                lowest, highest = (torch.stack([exact, *near]).amin(0), torch.stack([exact, *near]).amax(0))
                gap = torch.maximum(lowest - log_prob, log_prob - highest).clamp(min=0)
                error = torch.minimum(error, gap / scale / torch.finfo(torch.float32).eps)
            worst.record(
                error,
                lambda at, size=size, where=where, log_prob=log_prob, exact=exact: (
                    f"at {where}, raw parameters of size {size:g}: {log_prob[at].item():.9g}, "
                    f"in float64 {exact[at].item():.9g}"
                ),
            )


def _log_prob_near(subject: HeadSubject, head: DensityHead, raw: Tensor, value: Tensor) -> list[Tensor]:
    """Return log_prob of a float64 head at places within JUMP float32 epsilons of a value, among them narrow peaks.

    The places of a density are sums of numbers of the size of the raw parameters, in the target's unit. The epsilons
    are relative to the largest of these numbers and of the value. A peak that is narrower than this rounding is found
    among the mode and the mode candidates, number by number, since the density may be broad in another number.
    """
    largest = raw.abs().flatten(1).amax(1).view(-1, *[1] * (value.dim() - 1))
    unit = torch.tensor(subject.row.target.scale or 1.0, dtype=torch.float64)
    reach = JUMP * torch.finfo(torch.float32).eps * torch.maximum(value.double().abs(), largest * unit)
    with torch.no_grad():
        density = seeded(head, raw)
        offset = torch.cat([mode_candidates(density).double(), density.mode.double().unsqueeze(0)]) - value
        offset = wrap(offset) if isinstance(density.support, Circular) else offset
        nearest = offset.gather(0, offset.abs().argmin(0, keepdim=True))[0]
        at_peak = value.double() + nearest.where(nearest.abs() <= reach, 0.0)
        steps = [sign / 2**halving for halving in range(8) for sign in (-1, 1)]
        places = (at_peak, *(value.double() + step * reach for step in steps))
        return [density.log_prob(place) for place in places]


def rounding_change(
    subject: HeadSubject, head: DensityHead, raw: Tensor, value: Tensor, parameters: bool = False
) -> tuple[Tensor, Tensor]:
    """Return log_prob of a float64 head, and its first-order change per relative rounding error of the inputs.

    The change is Σ|r ∂log p/∂r| + Σ max(|y|, m)|∂log p/∂y| over raw parameters r and numbers y of the value, where m is
    π for angles and 0 for real numbers. With `parameters`, the sum over the head's own parameters is added.
    """
    arguments = {"raw": raw.clone().requires_grad_()}
    if value.is_floating_point():
        arguments["value"] = value.double().requires_grad_()
    log_prob = seeded(head, arguments["raw"]).log_prob(arguments.get("value", value))
    own = [part for part in head.parameters() if part.requires_grad] if parameters else []
    change = torch.zeros_like(log_prob)
    slopes = torch.autograd.grad(log_prob.sum(), list(arguments.values()), retain_graph=bool(own))
    least = {"value": math.pi if subject.row.target.kind == "angle" else 0.0}
    for (name, argument), slope in zip(arguments.items(), slopes, strict=True):
        size = argument.detach().abs().clamp(min=least.get(name, 0.0))
        change = change + (slope.abs() * size).flatten(log_prob.dim()).sum(-1)
    if own:  # all batch rows share the head's parameters, so that each row needs its own backward pass
        for row, row_log_prob in enumerate(log_prob):
            row_gradients = torch.autograd.grad(row_log_prob, own, retain_graph=True, allow_unused=True)
            parts = [
                (slope * part).abs().sum()
                for part, slope in zip(own, row_gradients, strict=True)
                if slope is not None
            ]
            change[row] = change[row] + sum(parts)
    return log_prob.detach(), change.detach()
