"""Measure accuracy and speed of the von Mises functions.

python -m benchmarks.densities.von_mises
"""

import math
import os
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import torch
from scipy import special, stats
from torch import Tensor

from benchmarks.pages import machine, replace_section, write_page
from benchmarks.timing import ROUNDS, median_and_range, require_idle, time_interleaved
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
    """Value and gradients of a million elements: torch, ours as it is and compiled."""
    lines = [
        "| dtype | way | value, ms | times torch's speed | value and gradients, ms | times torch's speed |",
        "|---|---|---|---|---|---|",
    ]
    ways = {"torch": of_torch, "as is": functions.log_prob, "compiled": COMPILED}
    for dtype in DTYPES:
        value, mean, logarithm = torch.randn(3, COUNT, dtype=dtype)
        arguments = (value, mean.requires_grad_(), torch.exp(2 * logarithm + 1).requires_grad_())
        detached = tuple(argument.detach() for argument in arguments)
        ones = torch.ones(COUNT, dtype=dtype)
        values = time_interleaved(
            {name: partial(value_only, density, arguments) for name, density in ways.items()}
        )
        one_pass = {"compiled, `log_prob_and_slopes`": partial(ONE_PASS, *detached)}
        gradients = time_interleaved(
            {name: partial(both, density, arguments, ones) for name, density in ways.items()} | one_pass
        )
        for name, found in gradients.items():
            cells = [str(dtype)[6:], name]
            cells += (
                [values[name].text(), values[name].times_faster(values["torch"])]
                if name in values
                else ["–", "–"]
            )
            lines.append(f"| {' | '.join([*cells, found.text(), found.times_faster(gradients['torch'])])} |")
    return lines


def sampling() -> list[str]:
    torch.manual_seed(1)
    lines = [
        "| κ | float32: KS distance | p | float64: KS distance | p | ms | torch, ms | times torch's speed |",
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
        ways: dict[str, Callable[[], object]] = {"ours": partial(functions.sample, zero, concentration)}
        # torch's sampler does not end at κ = 0 and from 1e16 on, and is wrong before
        if 0 < kappa <= 1e6:
            ways["torch"] = torch.distributions.VonMises(zero, concentration, validate_args=False).sample
        found = time_interleaved(ways, seconds=0.1)
        ours, theirs = found["ours"], found.get("torch")
        cells += [ours.text(), *([theirs.text(), ours.times_faster(theirs)] if theirs else ["–", "–"])]
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


def medians() -> list[str]:
    """The circular median of 64 × 10,000 samples, and two of them by all pairs."""
    samples = wrap(torch.randn(10_000, 64))

    def all_pairs() -> None:
        for row in samples.T[:2]:
            cost = torch.cat([wrap(part[:, None] - row).abs().mean(1) for part in row.split(500)])
            row[cost.argmin()]

    found = time_interleaved({"sorted": partial(circular_median, samples), "pairs": all_pairs}, seconds=0.1)
    ratios = [
        32 * slow / fast
        for fast, slow in zip(found["sorted"].milliseconds, found["pairs"].milliseconds, strict=True)
    ]
    return [
        f"Circular median of 64 × 10,000 samples, float32: {found['sorted'].text()} ms. Two of the 64 by all pairs "
        f"take {found['pairs'].text()} ms, so that all would take {median_and_range(ratios)} times as long."
    ]


SPEEDS = {
    "## Speed": (
        speed,
        f"{COUNT:,} elements; torch is torch.distributions.VonMises.",
    ),
    "## Sampling": (
        sampling,
        f"{COUNT:,} samples against `cdf`; the 95 % critical distance is 1.4e-3. Times of float64.",
    ),
    "## Point prediction": (medians, ""),
}
"""Sections with times: heading, what writes the lines, and what is said before them."""


def times() -> dict[str, str]:
    """The text of each section that has times."""
    torch.set_num_threads(1)
    require_idle()
    told = (
        f"One thread, processor time, each way in turn: median of {ROUNDS} rounds (least to largest). "
        f"{machine('torch', 'numpy', 'scipy')} Command: `python -m benchmarks.densities.von_mises --only times`."
    )
    return {
        heading: "\n".join([before, "", *lines(), "", told] if before else [*lines(), "", told])
        for heading, (lines, before) in SPEEDS.items()
    }


def report() -> str:
    """The whole page; the sections with times stay as they are until they are measured."""
    torch.set_num_threads(1)
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
            machine("torch", "numpy", "scipy", "mpmath")
            + " Command: `python -m benchmarks.densities.von_mises`.",
            "",
            *(line for heading in SPEEDS for line in (heading, "")),
        ]
    )


if __name__ == "__main__":
    page = Path(__file__).with_suffix(".md")
    sections = times()  # first: it ends where the machine is not idle
    if sys.argv[1:] != ["--only", "times"]:
        write_page(__file__, report())
    for heading, section in sections.items():
        replace_section(page, heading, section)
