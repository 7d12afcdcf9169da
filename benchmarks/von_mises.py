"""Accuracy and speed of the von Mises functions, written beside this file: `python benchmarks/von_mises.py`."""

import math
import os
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import torch
from scipy import special, stats
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks.machine import machine
from framework.distributions.circular import circular_median, wrap
from framework.distributions.density import Mixture
from plugins.density_head.von_mises import functions, integrals
from plugins.density_head.von_mises.density import VonMises
from plugins.density_head.von_mises.fit_coefficients import bessel

COUNT = 10**6
DTYPES = (torch.float32, torch.float64)
GROUPS = (
    (0, 1e-30, 1e-8, 1e-4, 1e-2),
    (0.1, 1, 3.75, 10),
    (50, 100, 500, 1e3),
    (1e4, 1e6, 1e8),
    (1e12, 1e30),
)
OFFSETS = (0.0, 1e-8, 1e-4, 0.1, 1.0, math.pi / 2, 3.0, math.pi, 2 * math.pi - 1e-6, -2 * math.pi, 1e6, -1e6)
SAMPLED = (0, 1e-3, 1, 100, 1e6, 1e12, 1e30)
# kernels that earlier programs had kept were seen to take nine times as long
KERNELS = tempfile.TemporaryDirectory()
os.environ["TORCHINDUCTOR_CACHE_DIR"] = KERNELS.name
COMPILED = torch.compile(functions.log_prob, dynamic=False, fullgraph=True)
ONE_PASS = torch.compile(functions.log_prob_and_slopes, dynamic=False, fullgraph=True)
Density = Callable[[Tensor, Tensor, Tensor], Tensor]


def of_torch(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    return torch.distributions.VonMises(mean, concentration, validate_args=False).log_prob(value)


def milliseconds(call: Callable[[], object], seconds: float = 1.0) -> float:
    """Least processor time of the calls that fit into `seconds`, at least five, after two to warm up."""
    for _ in range(2):
        call()
    times: list[float] = []
    while len(times) < 5 or sum(times) < seconds:
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * min(times)


def errors(density: Density, dtype: torch.dtype) -> list[list[float]]:
    """By group of κ: worst error in machine epsilons of log p, its derivatives in κ and μ, and of the entropy."""
    rows = [(3.0 + offset, 3.0, kappa) for group in GROUPS for kappa in group for offset in OFFSETS]
    value, mean, kappa = (torch.tensor(column, dtype=dtype) for column in zip(*rows, strict=True))
    mean.requires_grad_()
    kappa.requires_grad_()
    found = density(value, mean, kappa)
    by_mean, by_kappa = torch.autograd.grad(found.sum(), (mean, kappa))
    groups = [i for i, group in enumerate(GROUPS) for _ in group for _ in OFFSETS]
    worst = [[0.0] * 4 for _ in GROUPS]
    columns = (value, mean, kappa, found, by_kappa, by_mean, functions.entropy(kappa))
    lists = [column.tolist() for column in columns]
    for group, at, centre, k, *numbers in zip(groups, *lists, strict=True):
        exact = mpmath.mpf(k)
        scaled, complement = bessel(exact)
        turn = mpmath.mpf(at) - mpmath.mpf(centre)
        fall = 2 * mpmath.sin(turn / 2) ** 2
        height = -mpmath.log(2 * mpmath.pi) - scaled
        log_p, entropy = height - exact * fall, exact * complement - height
        turning = exact * mpmath.sin(turn)
        tiny = mpmath.mpf(torch.finfo(dtype).tiny)
        references = (log_p, complement - fall, turning, entropy)
        scales = (max(1, abs(log_p)), complement + fall, abs(turning) + tiny, max(1, abs(entropy)))
        for i, (number, reference, scale) in enumerate(zip(numbers, references, scales, strict=True)):
            error = abs(number - reference) / scale if math.isfinite(number) else mpmath.inf
            worst[group][i] = max(worst[group][i], float(error) / torch.finfo(dtype).eps)
    return worst


def accuracy() -> list[str]:
    lines = [
        "| dtype | κ | way | log p | d/dκ | d/dμ | entropy |",
        "|---|---|---|---|---|---|---|",
    ]
    for dtype in DTYPES:
        for name, density in (("as is", functions.log_prob), ("compiled", COMPILED)):
            for group, worst in zip(GROUPS, errors(density, dtype), strict=True):
                cells = " | ".join(f"{number:.1f}" for number in worst)
                lines.append(f"| {str(dtype)[6:]} | {group[0]:g} to {group[-1]:g} | {name} | {cells} |")
    return lines


def both(density: Density, arguments: tuple[Tensor, ...], ones: Tensor) -> None:
    torch.autograd.grad(density(*arguments), arguments[1:], ones)


@torch.no_grad()
def value_only(density: Density, arguments: tuple[Tensor, ...]) -> None:
    density(*arguments)


def speed() -> list[str]:
    lines = [
        "| dtype | way | value, ms | × torch | value and gradients, ms | × torch |",
        "|---|---|---|---|---|---|",
    ]
    for dtype in DTYPES:
        value, mean, spread = torch.randn(3, COUNT, dtype=dtype)
        arguments = (value, mean.requires_grad_(), torch.exp(2 * spread + 1).requires_grad_())
        ones = torch.ones(COUNT, dtype=dtype)
        peer: tuple[float, float] = (0.0, 0.0)
        for name, density in (("torch", of_torch), ("as is", functions.log_prob), ("compiled", COMPILED)):
            value_ms = milliseconds(lambda density=density, given=arguments: value_only(density, given))
            both_ms = milliseconds(
                lambda density=density, given=arguments, ones=ones: both(density, given, ones)
            )
            peer = (value_ms, both_ms) if name == "torch" else peer
            ratios = peer[0] / value_ms, peer[1] / both_ms
            lines.append(
                f"| {str(dtype)[6:]} | {name} | {value_ms:.2f} | {ratios[0]:.1f} | {both_ms:.2f} | {ratios[1]:.1f} |"
            )
        detached = tuple(argument.detach() for argument in arguments)
        one_ms = milliseconds(lambda given=detached: ONE_PASS(*given))
        lines.append(
            f"| {str(dtype)[6:]} | compiled, `log_prob_and_slopes` | - | - | {one_ms:.2f} | {peer[1] / one_ms:.1f} |"
        )
    return lines


def sampling() -> list[str]:
    torch.manual_seed(1)
    lines = [
        "| κ | float32: KS distance | p | float64: KS distance | p | ms | torch, ms | × torch |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kappa in SAMPLED:
        cells = []
        for dtype in DTYPES:
            zero, concentration = torch.zeros(COUNT, dtype=dtype), torch.full((COUNT,), kappa, dtype=dtype)
            drawn = functions.sample(zero, concentration).double()
            exact = concentration[:1].double()
            result = stats.kstest(
                drawn.numpy(), lambda at, k=exact: integrals.cdf(torch.from_numpy(at), k * 0, k).numpy()
            )
            cells.append(f"{result.statistic:.1e} | {result.pvalue:.2f}")
        ours = milliseconds(lambda k=concentration, m=zero: functions.sample(m, k), 0.3)
        # torch's sampler does not end at κ = 0 and from 1e16 on, and is wrong before
        if 0 < kappa <= 1e6:
            peer = torch.distributions.VonMises(zero, concentration, validate_args=False)
            theirs = milliseconds(lambda peer=peer: peer.sample(), 0.3)
            cells.append(f"{ours:.0f} | {theirs:.0f} | {theirs / ours:.1f}")
        else:
            cells.append(f"{ours:.0f} | - | -")
        lines.append(f"| {kappa:g} | {' | '.join(cells)} |")
    return lines


def moments() -> float:
    """Worst relative error of κ from its moments, κ = 1e-8 … 1e12."""
    worst = 0.0
    for power in range(-8, 13):
        _, complement = bessel(mpmath.mpf(10.0**power))
        found = functions.concentration_of_moments(
            *(torch.tensor(float(m), dtype=torch.float64) for m in (1 - complement, complement))
        )
        worst = max(worst, float(abs(found.item() / mpmath.mpf(10.0**power) - 1)))
    return worst


def distribution() -> float:
    """Worst absolute difference of the distribution function from the normal one of z = 2√κ sin(θ/2) at κ = 1e30."""
    kappa = torch.tensor(1e30, dtype=torch.float64)
    z = torch.linspace(-8, 8, 401, dtype=torch.float64)
    found = integrals.cdf(z * 1e-15, 0 * kappa, kappa)
    return float(abs(found.numpy() - special.ndtr(z.numpy())).max())


def entropy_of(weights: list[float], means: list[float], kappas: list[float]) -> float:
    """-∫ f log f of one mixture: 24 nodes of Gauss and Legendre between each two multiples of the components' scales
    about their means, every node and density in 50 digits."""
    with mpmath.workdps(50):
        weight, mean, kappa = ([mpmath.mpf(number) for number in row] for row in (weights, means, kappas))
        total = mpmath.fsum(weight)
        top = [mpmath.log(w / total) - mpmath.log(2 * mpmath.pi) - bessel(k)[0] if w else -mpmath.inf
               for w, k in zip(weight, kappa, strict=True)]  # fmt: skip
        scale = [1 / mpmath.sqrt(k + 1) for k in kappa]
        steps = (0, 1, 2, 3, 4.5, 6, 8, 11, 16)
        cuts = {m + side * t * s for m, s in zip(mean, scale, strict=True) for t in steps for side in (-1, 1)}
        cuts = sorted({cut for cut in cuts if abs(cut) < mpmath.pi} | {-mpmath.pi, mpmath.pi})
        kept, least = [cuts[0]], min(scale) / 4
        for cut in cuts[1:]:
            if cut - kept[-1] > least or cut == cuts[-1]:
                kept.append(cut)
        parts = []
        for low, high in pairwise(kept):
            middle, half = (low + high) / 2, (high - low) / 2
            near = []
            for m, k, t in zip(mean, kappa, top, strict=True):
                nearest = min(mpmath.pi, max(0, abs(wrapped(middle - m)) - half))
                if (
                    t - 2 * k * mpmath.sin(nearest / 2) ** 2 > -120
                ):  # what is less all over the part adds nothing
                    near.append((m, k, t))
            for node, share in zip(*np.polynomial.legendre.leggauss(24), strict=True):
                at = middle + half * node
                f = sum(mpmath.exp(t - 2 * k * mpmath.sin((at - m) / 2) ** 2) for m, k, t in near)
                parts.append(float(-half * share * f * mpmath.log(f)) if f > 0 else 0.0)
        return math.fsum(parts)


def wrapped(angle: Any) -> Any:
    return angle - 2 * mpmath.pi * mpmath.nint(angle / (2 * mpmath.pi))


def mixtures() -> list[str]:
    """Worst error, nats, of the entropy of random mixtures, by K: far apart, within three scales, at one place; of one
    κ, of any κ, and with weights down to 0."""
    chance = np.random.default_rng(3)
    lines = ["| K | mixtures | worst error, nats: float64 | float32 |", "|---|---|---|---|"]
    for count in (1, 2, 5, 12, 50):
        worst, cases = [0.0, 0.0], 0
        for power in (None, 0.0, 1e-3, 1.0, 30.0, 1e4, 1e8, 1e12, 1e20, 1e30):
            for spread in (0.0, 3.0, math.inf):
                kappas = np.full(count, power) if power is not None else 10 ** chance.uniform(-3, 30, count)
                means = chance.uniform(-3, 3, count)
                if math.isfinite(spread):
                    means = means[0] + spread * chance.standard_normal(count) / math.sqrt(1 + kappas[0])
                weights = chance.dirichlet(np.ones(count)) * (chance.random(count) > 0.1)
                weights[0] += 1e-9
                for i, dtype in enumerate(DTYPES[::-1]):
                    rows = [
                        torch.tensor(row, dtype=dtype)
                        for row in (weights, wrap(torch.tensor(means)).numpy(), kappas)
                    ]
                    parts = VonMises(rows[1][None, :, None], rows[2][None, :, None])
                    found = Mixture(rows[0].log()[None], parts).entropy().item()
                    # of the numbers as this type has them
                    wanted = entropy_of(*(row.double().tolist() for row in rows))
                    worst[i] = max(worst[i], abs(found - wanted))
                cases += 1
        lines.append(f"| {count} | {cases} | {worst[0]:.1e} | {worst[1]:.1e} |")
    return lines


def medians() -> tuple[float, float]:
    """Milliseconds of the circular median of 64 × 10,000 samples, and by all pairs: 2 rows' scaled up to 64."""
    samples = wrap(torch.randn(10_000, 64))

    def all_pairs() -> None:
        for row in samples.T[:2]:
            cost = torch.cat([wrap(part[:, None] - row).abs().mean(1) for part in row.split(500)])
            row[cost.argmin()]

    return milliseconds(lambda: circular_median(samples)), 32 * milliseconds(all_pairs, 0.1)


def report() -> str:
    torch.set_num_threads(1)
    fast, slow = medians()
    return "\n".join(
        [
            "# The von Mises functions: accuracy and speed",
            "",
            "## Accuracy",
            "",
            "Worst error in machine epsilons against 60 digits at angle differences from 0 to ±1e6 rad, mean 3: log p "
            "and entropy by max(1, |reference|), d/dκ by |cos(φ-μ) - 1| + 1 - A(κ), d/dμ relative.",
            "",
            *accuracy(),
            "",
            f"κ from moments (eq. 3.5), 1e-8 to 1e12: relative {moments():.1e}. Distribution function at κ = 1e30 "
            f"against the normal one: {distribution():.1e}.",
            "",
            "## Entropy of mixtures",
            "",
            "Worst error over κ 0 to 1e30 and K 1 to 50, against quadrature of 50 digits; components far apart, within "
            "three scales and at one place, of equal κ and of any, a tenth of the weights 0. float32 is of the numbers "
            "as float32 has them.",
            "",
            *mixtures(),
            "",
            "## Speed",
            "",
            f"{COUNT:,} elements, one thread, least processor time of several calls; "
            "torch is torch.distributions.VonMises.",
            "",
            *speed(),
            "",
            "## Sampling",
            "",
            f"{COUNT:,} samples against `cdf`; the 95 % critical distance is 1.4e-3. Times of float64.",
            "",
            *sampling(),
            "",
            "## Point prediction",
            "",
            f"Circular median of 64 × 10,000 samples, float32: {fast:.0f} ms; by all pairs {slow:,.0f} ms (two of the "
            f"64 measured and multiplied by 32): {slow / fast:.0f} ×.",
            "",
            machine("torch", "numpy", "scipy", "mpmath") + " Command: `python benchmarks/von_mises.py`.",
            "",
        ]
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(report())
