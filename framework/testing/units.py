"""Check of heads of reals whose target has a location and a scale: the density is in the target's own unit."""

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
from framework.testing.heads import HeadSubject
from framework.testing.questions import MANY, two_samples

Answer = TypeVar("Answer")
UNITS = ((200.0, 50.0), (0.3, 1e-5))
"""Location and scale, in turn, of the numbers of a target, as of a height in centimetres and a wavelength in metres."""
TOLERANCE = 1e-5


def units(subject: HeadSubject, worst: Worst) -> None:
    """Check that a target of location l and scale s has the density p((y - l)/s)/s.

    Here p is the density of the standardised target. A head may ignore location and scale and return the same density
    as without them; that passes.
    """
    head = subject.make()
    if head.direct or isinstance(head, Fitted):
        worst.count(
            False, "it reads features, which may be in the target's unit, or is fitted to targets at once"
        )
        return
    plain = replace(subject.row.target, location=(), scale=())
    for first in range(2):
        chosen = [UNITS[(first + number) % 2] for number in range(len(plain.names))]
        location, scale = (torch.tensor(part, dtype=torch.float64) for part in zip(*chosen, strict=True))
        target = replace(plain, location=tuple(location.tolist()), scale=tuple(scale.tolist()))
        _compare(subject, target, location, scale, worst)


def _compare(subject: HeadSubject, target: Target, location: Tensor, scale: Tensor, worst: Worst) -> None:
    assert subject.of is not None
    seed(SEED)
    try:
        head = subject.of(target).eval().double()
    except ConfigError:
        worst.count(False, "a target with location and scale is refused")
        return
    seed(SEED)
    alone = subject.of(replace(target, location=(), scale=())).eval().double()
    what = f"location {location[0].item():g}, scale {scale[0].item():g}"
    raw = subject.raws(12).double() * torch.tensor([0.3, 1.0, 3.0], dtype=torch.float64).repeat(4).unsqueeze(
        -1
    )
    standard = subject.values(12).double()
    with torch.no_grad():
        # some values near the mode, where a narrow density is not negligible
        standard[6:] = _after(lambda: alone(raw[6:]).sample()).double()
    value = location + scale * standard
    volume = scale.log().sum()
    with torch.no_grad():
        plain = _after(lambda: alone(raw))
        own = _after(lambda: head(raw))
        ignored = _after(lambda: plain.log_prob(value.to(plain.mode))).double()
        log_prob = _after(lambda: own.log_prob(value)).double()
        if torch.equal(ignored.nan_to_num(), log_prob.nan_to_num()):
            worst.count(False, "the head does not read the target's location and scale")
            return
        wanted = _after(lambda: plain.log_prob(standard)).double() - volume
        _see(worst, f"log_prob, {what}", log_prob, wanted, 1.0)
        entropy, without = _after(own.entropy).double(), _after(plain.entropy).double()
        _see(worst, f"entropy, {what}", entropy, without + volume, 1.0)
        _places(own, plain, location, scale, worst, what)
        drawn = own.sample(torch.Size((MANY,))).double()
        others = location + scale * plain.sample(torch.Size((MANY,))).double()
        inner = Worst()
        for row in range(0, 12, 5):
            two_samples(own, drawn[:, row], others[:, row], inner, f"row {row}")
        worst.see(TOLERANCE * inner.error, f"{inner.case}, {what}")
    losses, gradients = [], []
    for model, given in ((head, value), (alone, standard)):
        leaf = raw.clone().requires_grad_()
        loss = _after(lambda model=model, leaf=leaf, given=given: model.train().loss(leaf, given))
        losses.append((loss - loss[0]).detach())
        gradients.append(torch.autograd.grad(loss.sum(), leaf, allow_unused=True)[0])
        model.eval()
    found, wanted = losses
    _see(worst, f"loss of a row less that of the first, {what}", found, wanted, wanted.abs().amax().item())
    if all(one is not None for one in gradients):
        found, wanted = gradients
        _see(worst, f"gradient of the loss, {what}", found, wanted, wanted.abs().amax().item())
    with torch.no_grad():
        head.calibrate(raw, value)
        alone.calibrate(raw, standard)
        found, wanted = (
            _after(lambda model=model, given=given: model(raw).log_prob(given)).double()
            for model, given in ((head, value), (alone, standard))
        )
        _see(worst, f"log_prob after calibrate, {what}", found, wanted - volume, 1.0)


def _places(
    own: Distribution, plain: Distribution, location: Tensor, scale: Tensor, worst: Worst, what: str
) -> None:
    """Check mode, moments, median, marginals and cdf of both densities in the standardised unit."""
    for name in ("mode", "mean", "variance"):
        try:
            found, wanted = getattr(own, name).double(), getattr(plain, name).double()
        except (NotImplementedError, AttributeError):
            continue
        found = found / scale.square() if name == "variance" else (found - location) / scale
        _see(worst, f"{name}, {what}", found, wanted, 1.0)
    middle = [(_after(lambda density=density: median(density, 500))).double() for density in (own, plain)]
    _see(worst, f"median, {what}", (middle[0] - location) / scale, middle[1], 1.0)
    place = plain.mode.double() + 0.3
    for number in range(len(location)):
        here = slice(number, number + 1)
        try:
            one, other = marginal(own, number), marginal(plain, number)
        except UserError:
            return
        given = location[here] + scale[here] * place[..., here]
        wanted = _after(lambda other=other, here=here: other.log_prob(place[..., here])).double()
        found = _after(lambda one=one, given=given: one.log_prob(given)).double() + scale[here].log()
        _see(worst, f"marginal of number {number}, {what}", found, wanted, 1.0)
        masses = cdf(one, given), cdf(other, place[..., here])
        if masses[0] is not None and masses[1] is not None:
            _see(worst, f"cdf of number {number}, {what}", masses[0], masses[1], 1.0)


def _see(worst: Worst, what: str, found: Tensor, wanted: Tensor, least: float) -> None:
    """Record the difference, relative to the wanted value where that is above `least`, else to `least`."""
    apart = torch.where((found == wanted) | (found.isnan() & wanted.isnan()), 0.0, (found - wanted).abs())
    worst.see(apart / wanted.nan_to_num(nan=0.0).abs().clamp(min=max(least, math.ulp(1.0))), what)


def _after(ask: Callable[[], Answer]) -> Answer:
    seed(SEED)
    return ask()
