"""Faulty replacements for results of densities, losses and heads: functions of the correct object and the arguments."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.density_head import DensityHead
from framework.distributions.protocol import marginal
from plugins.density_head.von_mises.density import VonMises
from tests.planted_heads import Faulty


def off(by: float, where: Callable[[Tensor], Tensor]) -> Callable[..., Tensor]:
    """Return a log_prob that is `by` too large where the largest parameter, κ or σ, fulfils a condition."""
    return lambda density, value: density.log_prob(value) + by * where(spread_of(density).amax(-1))


def spread_of(density: Distribution) -> Tensor:
    return density.concentration if isinstance(density, VonMises) else density.scale  # pyright: ignore


def width(density: Distribution) -> Tensor:
    """Return roughly the standard deviation."""
    if isinstance(density, VonMises):
        return (1 / (1 + density.concentration)).sqrt()
    return density.scale  # pyright: ignore[reportAttributeAccessIssue]


def everywhere(parameter: Tensor) -> Tensor:
    return torch.ones_like(parameter)


def with_slope(factor: float, where: Callable[[Tensor], Tensor]) -> Callable[..., Tensor]:
    """Return a correct loss, but with the gradient in κ multiplied by `factor` where κ fulfils a condition."""

    def loss(head: DensityHead, raw: Tensor, target: Tensor) -> Tensor:
        density = head(raw)
        kappa = density.concentration
        bent = factor * kappa + (1 - factor) * kappa.detach()
        return -VonMises(density.location, torch.where(where(kappa), bent, kappa)).log_prob(target)

    return loss


def capped(density: Any, shape: torch.Size) -> Tensor:
    return VonMises(density.location, density.concentration.clamp(max=1e3)).sample(shape)


def remembering(head: Faulty, raw: Tensor) -> Distribution:
    head.calls += 1
    return head.sound(raw * (1 + 1e-3 * head.calls))


def batch_wide(head: Faulty, raw: Tensor) -> Distribution:
    mean = raw.detach().mean(0, keepdim=True) if raw.dim() > 1 and raw.numel() else 0.0
    return head.sound(raw - 0.1 * mean)


def unseeded(density: Any, shape: torch.Size) -> Tensor:
    with torch.random.fork_rng():
        torch.seed()
        return density.sample(shape)


def in_half(density: Any, value: Tensor) -> Tensor:
    return density.log_prob(value.half().float() if value.dtype == torch.float32 else value)


def nan_far(density: Any, value: Tensor) -> Tensor:
    found = density.log_prob(value)
    return torch.where(density.concentration[..., 0] > 1e8, math.nan, found)


def refusing(what: Callable[[Tensor], bool], error: str) -> Callable[..., Distribution]:
    def forward(head: Faulty, raw: Tensor) -> Distribution:
        if what(raw):
            raise RuntimeError(error)
        return head.sound(raw)

    return forward


def accepting(head: Faulty, raw: Tensor) -> Distribution:
    return head.sound(raw.nan_to_num(0.0, 0.0, 0.0))


def nameless(head: Faulty, raw: Tensor) -> Distribution:
    if not raw.isfinite().all():
        raise ValueError("bad numbers")
    return head.sound(raw)


def shared_noise(density: Any, shape: torch.Size) -> Tensor:
    """Return samples with the same noise for every row of the batch."""
    whole = (*shape, *density.location.shape)
    noise = torch.randn(
        *shape, *([1] * len(density.batch_shape)), 1, dtype=density.scale.dtype, device=density.scale.device
    )
    return density.location + density.scale * noise.expand(whole)


def worse(head: Faulty, raw: Tensor) -> None:
    head.sound.concentration.fill_(1e6)  # pyright: ignore


def changes_parameter(head: Faulty, raw: Tensor) -> None:
    assert head.weight is not None
    head.weight.data.add_(1.0)


def smoothed(density: Any, value: Tensor) -> Tensor:
    return density.log_prob(value).clamp(min=math.log(1e-3))


def below_labels(density: Any, shape: torch.Size) -> Tensor:
    return density.sample(shape).clamp(max=1)


def second_as_first(density: Any, shape: torch.Size) -> Tensor:
    """Return samples whose numbers have the same noise, so that only the marginals are correct."""
    noise = torch.randn(
        *shape, *density.batch_shape, 1, dtype=density.scale.dtype, device=density.scale.device
    )
    return density.location + density.scale * noise


def no_second(density: Any, shape: torch.Size) -> Tensor:
    drawn = density.sample(shape)
    return torch.stack([drawn[..., 0], density.location[..., 1].expand_as(drawn[..., 1])], -1)


def first_only(density: Any) -> Tensor:
    return marginal(density, 0).entropy()


def laplace(density: Any, shape: torch.Size) -> Tensor:
    drawn = torch.rand(
        (*shape, *density.location.shape), dtype=density.scale.dtype, device=density.scale.device
    )
    return density.location + density.scale * math.sqrt(12) * (drawn - 0.5)


def fitting_entropy(density: Any) -> Tensor:
    """Return the entropy integral of the density p exp(c), which is not normalised, for c = 3e-6."""
    return math.exp(3e-6) * (density.entropy() - 3e-6)


def lower_for_narrow(density: Any) -> Tensor:
    return density.entropy() - 0.1 * (density.concentration.amax(-1) > 1e3)


def four_know_each_other(head: Faulty, raw: Tensor) -> Distribution:
    return head.sound(raw + 0.01 * raw.detach().tanh().mean(0) if raw.dim() > 1 and len(raw) == 4 else raw)


def counting(head: Faulty, raw: Tensor) -> Distribution:
    if not head.training:
        head.sound.calls = getattr(head.sound, "calls", 0) + 1  # pyright: ignore
    return head.sound(raw)


def counted_loss(sound: DensityHead, raw: Tensor, target: Tensor) -> Tensor:
    return getattr(sound, "calls", 0) - sound(raw).log_prob(target)


def doubled_when_stacked(head: Faulty, raw: Tensor) -> Distribution:
    return head.sound(raw * 1.5 if raw.dim() == 3 and raw.shape[-2] == 1 else raw)
