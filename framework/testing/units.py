"""Check that a head for a real-valued target with location and scale returns densities in the target's unit."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import Fitted
from framework.distributions.protocol import cdf, marginal, median
from framework.errors import ConfigError, UserError
from framework.target import Target
from framework.testing.finding import SEED, Worst, seed
from framework.testing.head_subject import HeadSubject
from framework.testing.protocol_checks import MANY, compare_draws

Result = TypeVar("Result")
UNITS = ((200.0, 50.0), (0.3, 1e-5))
"""Two pairs of location and scale, which the numbers of a target have alternately.

For example, a target may contain a height in centimetres and a wavelength in metres.
"""
TOLERANCE = 1e-5
"""Largest relative error that passes."""


def units(subject: HeadSubject, worst: Worst) -> None:
    """Check that a target with location l and scale s has the density p((y - l)/s)/s.

    Here y is a value, and p is the density that the head returns for a target without location and scale. A head also
    passes if it ignores location and scale, and returns the same density as without them.

    Args:
        subject: Head under test.
        worst: Recorder of the largest error.
    """
    head = subject.make()
    if head.direct or isinstance(head, Fitted):
        worst.count(
            False,
            "the head reads features in the target's unit or is fitted to targets, so its density need not scale",
        )
        return
    plain = replace(subject.row.target, location=(), scale=())
    for first in range(2):
        chosen = [UNITS[(first + number) % 2] for number in range(len(plain.names))]
        location, scale = (torch.tensor(part, dtype=torch.float64) for part in zip(*chosen, strict=True))
        target = replace(plain, location=tuple(location.tolist()), scale=tuple(scale.tolist()))
        _compare_units(subject, target, location, scale, worst)


def _compare_units(
    subject: HeadSubject, target: Target, location: Tensor, scale: Tensor, worst: Worst
) -> None:
    assert subject.build_for is not None
    seed(SEED)
    try:
        head = subject.build_for(target).eval().double()
    except ConfigError:
        worst.count(False, "the head refuses a target with location and scale")
        return
    seed(SEED)
    alone = subject.build_for(replace(target, location=(), scale=())).eval().double()
    unit = f"location {location[0].item():g}, scale {scale[0].item():g}"
    raw = subject.scaled_parameters([0.3, 1.0, 3.0] * 4)
    standard = subject.values(12).double()
    with torch.no_grad():
        # some values near the mode, where a narrow density is not negligible
        standard[6:] = _call_seeded(lambda: alone(raw[6:]).sample()).double()
    value = location + scale * standard
    volume = scale.log().sum()
    with torch.no_grad():
        plain = _call_seeded(lambda: alone(raw))
        own = _call_seeded(lambda: head(raw))
        ignored = _call_seeded(lambda: plain.log_prob(value.to(plain.mode))).double()
        log_prob = _call_seeded(lambda: own.log_prob(value)).double()
        if torch.equal(ignored.nan_to_num(), log_prob.nan_to_num()):
            worst.count(False, "the head ignores the target's location and scale")
            return
        expected = _call_seeded(lambda: plain.log_prob(standard)).double() - volume
        _record_gap(worst, f"log_prob, {unit}", log_prob, expected, 1.0)
        entropy, without = _call_seeded(own.entropy).double(), _call_seeded(plain.entropy).double()
        _record_gap(worst, f"entropy, {unit}", entropy, without + volume, 1.0)
        _compare_locations(own, plain, location, scale, worst, unit)
        draws = own.sample(torch.Size((MANY,))).double()
        expected_draws = location + scale * plain.sample(torch.Size((MANY,))).double()
        inner = Worst()
        for row in range(0, 12, 5):
            compare_draws(own, draws[:, row], expected_draws[:, row], inner, f"row {row}")
        worst.record(TOLERANCE * inner.error, f"{inner.case}, {unit}")
    losses, gradients = [], []
    for model, targets in ((head, value), (alone, standard)):
        leaf = raw.clone().requires_grad_()
        loss = _call_seeded(lambda model=model, leaf=leaf, targets=targets: model.train().loss(leaf, targets))
        losses.append((loss - loss[0]).detach())
        gradients.append(torch.autograd.grad(loss.sum(), leaf, allow_unused=True)[0])
        model.eval()
    actual, expected = losses
    _record_gap(
        worst,
        f"difference of each loss from the first, {unit}",
        actual,
        expected,
        expected.abs().amax().item(),
    )
    if all(row_gradient is not None for row_gradient in gradients):
        actual, expected = gradients
        _record_gap(worst, f"gradient of the loss, {unit}", actual, expected, expected.abs().amax().item())
    with torch.no_grad():
        head.calibrate(raw, value)
        alone.calibrate(raw, standard)
        # new values, because the calibrated density may jump at the values that calibrated it
        standard = _call_seeded(lambda: alone(raw).sample()).double()
        value = location + scale * standard
        actual, expected = (
            _call_seeded(lambda model=model, targets=targets: model(raw).log_prob(targets)).double()
            for model, targets in ((head, value), (alone, standard))
        )
        _record_gap(worst, f"log_prob after calibrate, {unit}", actual, expected - volume, 1.0)


def _compare_locations(
    own: Distribution, plain: Distribution, location: Tensor, scale: Tensor, worst: Worst, unit: str
) -> None:
    """Compare the densities of two heads: mode, moments, median, marginals and cdf, in the standardised unit.

    Args:
        own: Density of the target with location and scale.
        plain: Density of the standardised target.
        location: Location of the target.
        scale: Scale of the target.
        worst: Recorder of the largest error.
        unit: Description of the unit, for the finding.
    """
    for name in ("mode", "mean", "variance"):
        try:
            actual, expected = getattr(own, name).double(), getattr(plain, name).double()
        except (NotImplementedError, AttributeError):
            continue
        actual = actual / scale.square() if name == "variance" else (actual - location) / scale
        _record_gap(worst, f"{name}, {unit}", actual, expected, 1.0)
    middle = [
        (_call_seeded(lambda density=density: median(density, 500))).double() for density in (own, plain)
    ]
    _record_gap(worst, f"median, {unit}", (middle[0] - location) / scale, middle[1], 1.0)
    place = plain.mode.double() + 0.3
    for number in range(len(location)):
        this_number = slice(number, number + 1)
        try:
            own_marginal, plain_marginal = marginal(own, number), marginal(plain, number)
        except UserError:
            return
        value = location[this_number] + scale[this_number] * place[..., this_number]
        expected = _call_seeded(
            lambda plain_marginal=plain_marginal, this_number=this_number: plain_marginal.log_prob(
                place[..., this_number]
            )
        ).double()
        actual = (
            _call_seeded(lambda own_marginal=own_marginal, value=value: own_marginal.log_prob(value)).double()
            + scale[this_number].log()
        )
        _record_gap(worst, f"marginal of number {number}, {unit}", actual, expected, 1.0)
        masses = cdf(own_marginal, value), cdf(plain_marginal, place[..., this_number])
        if masses[0] is not None and masses[1] is not None:
            _record_gap(worst, f"cdf of number {number}, {unit}", masses[0], masses[1], 1.0)


def _record_gap(worst: Worst, label: str, actual: Tensor, expected: Tensor, least: float) -> None:
    """Record |actual - expected|, divided by |expected| or by `least`, whichever is larger."""
    gap = torch.where(
        (actual == expected) | (actual.isnan() & expected.isnan()), 0.0, (actual - expected).abs()
    )
    worst.record(gap / expected.nan_to_num(nan=0.0).abs().clamp(min=max(least, math.ulp(1.0))), label)


def _call_seeded(function: Callable[[], Result]) -> Result:
    seed(SEED)
    return function()
