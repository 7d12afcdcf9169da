"""Measure accuracy and speed of the von Mises functions.

    python -m benchmarks.densities.von_mises [--only times]

Writes von_mises.md into the folder of this file. `--only times` measures and replaces only the sections with times. The
script ends without a measurement if other processes use the machine.
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
from benchmarks.timing import ROUNDS, Rounds, first_calls, median_and_range, require_idle, time_interleaved
from framework.distributions.circular import circular_median, wrap
from framework.distributions.density import Mixture
from framework.prediction import Prediction
from framework.target import Target
from plugins.density_head.von_mises import functions, integrals
from plugins.density_head.von_mises.density import VonMises
from plugins.density_head.von_mises.fit_coefficients import bessel
from plugins.density_head.von_mises.processor import FEWEST, FEWEST_ONCE
from plugins.metric.coverage.metric import Coverage

COUNT = 10**6
COUNTS = (1, 64, 1000, COUNT)
DTYPES = (torch.float32, torch.float64)
GROUPS = (
    (0, 1e-30, 1e-8, 1e-4, 1e-2),
    (0.1, 1, 3.75, 10),
    (50, 100, 500, 1e3),
    (1e4, 1e6, 1e8),
    (1e12, 1e30),
)
"""Values of κ; each group is a row of the table of errors."""
OFFSETS = (0.0, 1e-8, 1e-4, 0.1, 1.0, math.pi / 2, 3.0, math.pi, 2 * math.pi - 1e-6, -2 * math.pi, 1e6, -1e6)
"""Differences of the angle from the mean, rad."""
SAMPLED = (0, 1e-3, 1, 100, 1e6, 1e12, 1e30)
"""Values of κ for which samples are compared with the distribution function."""
# an empty cache, because kernels from the cache of earlier programs sometimes took nine times as long
KERNELS = tempfile.TemporaryDirectory()
os.environ["TORCHINDUCTOR_CACHE_DIR"] = KERNELS.name
COMPILED = torch.compile(functions.log_prob, dynamic=False, fullgraph=True)
Density = Callable[[Tensor, Tensor, Tensor], Tensor]


def torch_log_prob(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Return the log-density by `torch.distributions`."""
    return torch.distributions.VonMises(mean, concentration, validate_args=False).log_prob(value)


def log_prob(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Return the log-density by the class `VonMises`."""
    return VonMises(mean[:, None], concentration[:, None]).log_prob(value[:, None])


def log_prob_of_many(value: Tensor, mean: Tensor, concentration: Tensor) -> Tensor:
    """Return the log-density by the class `VonMises`, of so many elements that compiled code computes them."""
    repeats = -(-FEWEST // len(value))
    return log_prob(*(tensor.repeat(repeats) for tensor in (value, mean, concentration)))[: len(value)]


def largest_errors(density: Density, dtype: torch.dtype) -> list[list[float]]:
    """Return for each group of κ the largest errors, in machine epsilons, of log p, d/dκ, d/dμ and entropy."""
    rows = [(3.0 + offset, 3.0, kappa) for group in GROUPS for kappa in group for offset in OFFSETS]
    value, mean, kappa = (torch.tensor(column, dtype=dtype) for column in zip(*rows, strict=True))
    mean.requires_grad_()
    kappa.requires_grad_()
    log_prob = density(value, mean, kappa)
    by_mean, by_kappa = torch.autograd.grad(log_prob.sum(), (mean, kappa))
    groups = [i for i, group in enumerate(GROUPS) for _ in group for _ in OFFSETS]
    worst = [[0.0] * 4 for _ in GROUPS]
    columns = (value, mean, kappa, log_prob, by_kappa, by_mean, functions.entropy(kappa))
    lists = [column.tolist() for column in columns]
    for group, at, centre, k, *numbers in zip(groups, *lists, strict=True):
        exact = mpmath.mpf(k)
        scaled, complement = bessel(exact)
        difference = mpmath.mpf(at) - mpmath.mpf(centre)
        fall = 2 * mpmath.sin(difference / 2) ** 2
        height = -mpmath.log(2 * mpmath.pi) - scaled
        log_p, entropy = height - exact * fall, exact * complement - height
        slope = exact * mpmath.sin(difference)
        tiny = mpmath.mpf(torch.finfo(dtype).tiny)
        references = (log_p, complement - fall, slope, entropy)
        scales = (max(1, abs(log_p)), complement + fall, abs(slope) + tiny, max(1, abs(entropy)))
        for i, (number, reference, scale) in enumerate(zip(numbers, references, scales, strict=True)):
            error = abs(number - reference) / scale if math.isfinite(number) else mpmath.inf
            worst[group][i] = max(worst[group][i], float(error) / torch.finfo(dtype).eps)
    return worst


def accuracy_table() -> list[str]:
    """Return the lines of the table of errors."""
    lines = [
        "| dtype | range of κ | elements | log p | d/dκ | d/dμ | entropy |",
        "|---|---|---|---|---|---|---|",
    ]
    for dtype in DTYPES:
        for name, density in (("few", log_prob), ("many", log_prob_of_many), ("torch.compile", COMPILED)):
            for group, worst in zip(GROUPS, largest_errors(density, dtype), strict=True):
                cells = " | ".join(f"{number:.1f}" for number in worst)
                lines.append(f"| {str(dtype)[6:]} | {group[0]:g} to {group[-1]:g} | {name} | {cells} |")
    return lines


def compute_gradients(density: Density, arguments: tuple[Tensor, ...], ones: Tensor) -> None:
    """Compute log p and its derivatives in μ and κ."""
    torch.autograd.grad(density(*arguments), arguments[1:], ones)


@torch.no_grad()
def compute_value(density: Density, arguments: tuple[Tensor, ...], ones: Tensor) -> None:
    """Compute log p without a gradient."""
    density(*arguments)


def speed_table() -> list[str]:
    """Return the lines of the table of times of log p and its gradients, for torch's class and ours."""
    lines = [
        "| dtype | elements | class | log p | speed-up over torch | log p and gradients | speed-up over torch |",
        "|---|---|---|---|---|---|---|",
    ]
    densities = {"torch": torch_log_prob, "ours": log_prob}
    for dtype in DTYPES:
        for count in COUNTS:
            value, mean, logarithm = torch.randn(3, count, dtype=dtype)
            arguments = (value, mean.requires_grad_(), torch.exp(2 * logarithm + 1).requires_grad_())
            ones = torch.ones(count, dtype=dtype)
            values, gradients = (
                time_interleaved(
                    {name: partial(compute, density, arguments, ones) for name, density in densities.items()},
                    seconds=0.2,
                )
                for compute in (compute_value, compute_gradients)
            )
            for name in densities:
                cells = [str(dtype)[6:], f"{count:,}", name]
                for rounds in (values, gradients):
                    cells += [f"{rounds[name].text()} ms", rounds[name].times_faster(rounds["torch"])]
                lines.append(f"| {' | '.join(cells)} |")
    return lines


def sampling_table() -> list[str]:
    """Return the lines of the table of samples: distance from the distribution function, and times."""
    torch.manual_seed(1)
    lines = [
        "| κ | KS distance, float32 | p, float32 | KS distance, float64 | p, float64 | ours, ms | torch, ms | "
        "speed-up over torch |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kappa in SAMPLED:
        cells = []
        for dtype in DTYPES:
            zero, concentration = torch.zeros(COUNT, dtype=dtype), torch.full((COUNT,), kappa, dtype=dtype)
            density = VonMises(zero[:, None], concentration[:, None])
            samples = density.sample()[:, 0].double()
            exact = concentration[:1].double()
            result = stats.kstest(
                samples.numpy(), lambda at, k=exact: integrals.cdf(torch.from_numpy(at), k * 0, k).numpy()
            )
            cells.append(f"{result.statistic:.1e} | {result.pvalue:.2f}")
        samplers: dict[str, Callable[[], object]] = {"ours": density.sample}
        # torch's sampler does not terminate for κ = 0 and from 1e16 on, and is wrong for smaller κ above 1e6
        if 0 < kappa <= 1e6:
            samplers["torch"] = torch.distributions.VonMises(zero, concentration, validate_args=False).sample
        times = time_interleaved(samplers, seconds=0.1)
        ours, theirs = times["ours"], times.get("torch")
        cells += [ours.text(), *([theirs.text(), ours.times_faster(theirs)] if theirs else ["–", "–"])]
        lines.append(f"| {kappa:g} | {' | '.join(cells)} |")
    return lines


def largest_error_from_moments() -> float:
    """Return the largest relative error of κ that is computed from its moments, for κ from 1e-8 to 1e12."""
    worst = 0.0
    for power in range(-8, 13):
        _, complement = bessel(mpmath.mpf(10.0**power))
        kappa = functions.concentration_of_moments(
            *(torch.tensor(float(m), dtype=torch.float64) for m in (1 - complement, complement))
        )
        worst = max(worst, float(abs(kappa.item() / mpmath.mpf(10.0**power) - 1)))
    return worst


def largest_error_of_cdf() -> float:
    """Return the largest difference of the cdf at κ = 1e30 from the normal cdf of z = 2√κ sin(θ/2)."""
    kappa = torch.tensor(1e30, dtype=torch.float64)
    z = torch.linspace(-8, 8, 401, dtype=torch.float64)
    actual = integrals.cdf(z * 1e-15, 0 * kappa, kappa)
    return float(abs(actual.numpy() - special.ndtr(z.numpy())).max())


def entropy_of(weights: list[float], means: list[float], kappas: list[float]) -> float:
    """Return the entropy -∫ f log f of one mixture by quadrature in 50 digits.

    The circle is cut at multiples of each component's width on both sides of its mean. Each part has 24 Gauss-Legendre
    nodes.
    """
    with mpmath.workdps(50):
        weight, mean, kappa = ([mpmath.mpf(number) for number in row] for row in (weights, means, kappas))
        total = mpmath.fsum(weight)
        top = [mpmath.log(w / total) - mpmath.log(2 * mpmath.pi) - bessel(k)[0] if w else -mpmath.inf
               for w, k in zip(weight, kappa, strict=True)]  # fmt: skip
        scale = [1 / mpmath.sqrt(k + 1) for k in kappa]
        steps = (0, 1, 2, 3, 4.5, 6, 8, 11, 16)
        cuts = {m + side * t * s for m, s in zip(mean, scale, strict=True) for t in steps for side in (-1, 1)}
        cuts = sorted({cut for cut in cuts if abs(cut) < mpmath.pi} | {-mpmath.pi, mpmath.pi})
        ends, least = [cuts[0]], min(scale) / 4
        for cut in cuts[1:]:
            if cut - ends[-1] > least or cut == cuts[-1]:
                ends.append(cut)
        parts = []
        for low, high in pairwise(ends):
            middle, half = (low + high) / 2, (high - low) / 2
            near = []
            for m, k, t in zip(mean, kappa, top, strict=True):
                nearest = min(mpmath.pi, max(0, abs(wrap_exactly(middle - m)) - half))
                # a component whose density is below exp(-120) on the whole part is left out
                if t - 2 * k * mpmath.sin(nearest / 2) ** 2 > -120:
                    near.append((m, k, t))
            for node, share in zip(*np.polynomial.legendre.leggauss(24), strict=True):
                at = middle + half * node
                f = sum(mpmath.exp(t - 2 * k * mpmath.sin((at - m) / 2) ** 2) for m, k, t in near)
                parts.append(float(-half * share * f * mpmath.log(f)) if f > 0 else 0.0)
        return math.fsum(parts)


def wrap_exactly(angle: Any) -> Any:
    """Return an angle of mpmath in [-π, π]."""
    return angle - 2 * mpmath.pi * mpmath.nint(angle / (2 * mpmath.pi))


def mixture_table() -> list[str]:
    """Return the lines of the table of the largest errors of the entropy of random mixtures, for each K.

    Means are far apart, scattered by three widths, or equal. All κ are equal, or random. A tenth of the weights is 0.
    """
    chance = np.random.default_rng(3)
    lines = [
        "| components K | mixtures | largest error in float64, nats | largest error in float32, nats |",
        "|---|---|---|---|",
    ]
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
                    entropy = Mixture(rows[0].log()[None], parts).entropy().item()
                    # the reference uses the parameters as they are rounded to this dtype
                    reference = entropy_of(*(row.double().tolist() for row in rows))
                    worst[i] = max(worst[i], abs(entropy - reference))
                cases += 1
        lines.append(f"| {count} | {cases} | {worst[0]:.1e} | {worst[1]:.1e} |")
    return lines


def time_coverage() -> list[str]:
    """Return the text on the time of the metric `coverage` for von Mises densities."""
    target = Target("angle", ("azimuth",))
    texts = []
    for rows in (64, 1000):
        density = VonMises(torch.randn(rows, 1), torch.exp(2 * torch.randn(rows, 1) + 1))
        prediction = Prediction(density, {"target": torch.randn(rows, 1)})
        metric = Coverage(target)
        times = time_interleaved({"coverage": partial(metric.update, prediction)}, seconds=0.2)["coverage"]
        texts.append(
            f"{Rounds(tuple(number / rows for number in times.milliseconds)).text()} ms in a batch of {rows:,} "
            "rows"
        )
    return [
        "For von Mises densities of one angle in float32, the metric `coverage` takes this time per row: "
        f"{' and '.join(texts)}."
    ]


def time_first_calls() -> list[str]:
    """Return the text on the time of the first call of compiled code, without and with a cache."""
    script = (
        "import time, torch\nfrom plugins.density_head.von_mises.density import VonMises\n"
        "tensors = [torch.rand(10_000, 1, requires_grad=True) for _ in range(3)]\n"
        "VonMises(*(tensor[:100] for tensor in tensors[1:])).log_prob(tensors[0][:100]).sum().backward()\n"
        "start = time.perf_counter()\nVonMises(*tensors[1:]).log_prob(tensors[0]).sum().backward()\n"
        "print(time.perf_counter() - start)"
    )
    cold, warm = first_calls(script, NUMBA_CACHE_DIR="{}")
    return [
        "The first log-density and gradient of von Mises densities with 10,000 elements in a process takes "
        f"{cold:.2g} s without a cache of compiled code and {warm:.2g} s with one; most of the latter time is the "
        f"import of numba. A process imports numba only if it computes at least {FEWEST:,} elements at once with "
        f"gradients, or at least {FEWEST_ONCE:,} without gradients."
    ]


def time_medians() -> list[str]:
    """Return the text on the time of the circular median of 64 × 10,000 samples, and of two of them by all pairs."""
    samples = wrap(torch.randn(10_000, 64))

    def all_pairs() -> None:
        for row in samples.T[:2]:
            cost = torch.cat([wrap(part[:, None] - row).abs().mean(1) for part in row.split(500)])
            row[cost.argmin()]

    times = time_interleaved({"sorted": partial(circular_median, samples), "pairs": all_pairs}, seconds=0.1)
    ratios = [
        32 * slow / fast
        for fast, slow in zip(times["sorted"].milliseconds, times["pairs"].milliseconds, strict=True)
    ]
    return [
        "The point prediction for an angle is the circular median of samples of its density. For 64 angles with 10,000 "
        f"samples each, in float32, it takes {times['sorted'].text()} ms. A method that compares all pairs of samples "
        f"takes {times['pairs'].text()} ms for two of the 64 angles. For all 64 angles it would take "
        f"{median_and_range(ratios)} times as long as the method of this project."
    ]


SPEEDS = {
    "## Speed": (
        speed_table,
        "The log-density of independent angles was computed by the class `VonMises` of the project (ours) and by "
        "torch.distributions.VonMises (torch), each constructed in every call. The gradients are with respect to the "
        "mean μ and the concentration κ.",
    ),
    "## First call": (time_first_calls, ""),
    "## Sampling": (
        sampling_table,
        f"For each concentration κ, {COUNT:,} samples from a von Mises density were compared with the distribution "
        "function by a Kolmogorov-Smirnov (KS) test. A distance above 1.4e-3 is significant at the level of 5 %, and "
        "p is the p-value. The times to draw the samples were measured in float64. A dash means that the sampler of "
        "torch does not terminate, or is wrong, at this κ.",
    ),
    "## Coverage": (time_coverage, ""),
    "## Point prediction": (time_medians, ""),
}
"""Sections with times: the heading, the function that returns the lines, and the text before the lines."""


def timed_sections() -> dict[str, str]:
    """Measure the times and return the text of each section with times, by heading."""
    torch.set_num_threads(1)
    require_idle()
    conditions = (
        "All times in this section are processor times of one thread. The compared implementations were called in "
        f"interleaved rounds; a number is the median of {ROUNDS} rounds (least to largest). "
        f"{machine('torch', 'numpy', 'scipy')} Command: `python -m benchmarks.densities.von_mises --only times`."
    )
    return {
        heading: "\n".join([*([before, ""] if before else []), *lines(), "", conditions])
        for heading, (lines, before) in SPEEDS.items()
    }


def report() -> str:
    """Measure the accuracy and return the page; its sections with times are empty."""
    torch.set_num_threads(1)
    return "\n".join(
        [
            "# The von Mises functions: accuracy and speed",
            "",
            "This page shows how accurate the project's von Mises functions are, compared with references of 50 or 60 "
            "digits, and how fast they are, compared with torch's functions.",
            "",
            "## Accuracy",
            "",
            "The table gives the largest errors of the log-density log p of a von Mises density, of its derivatives "
            "in κ and μ, and of the entropy, in machine epsilons of the dtype. The references have 60 digits. The "
            "mean μ is 3 rad, and the angle φ differs from it by 0 to ±1e6 rad. The column `elements` names the "
            "code that is used: torch operations for `few` elements, the project's compiled code for `many` "
            f"({FEWEST:,} or more), and the code that torch compiles for `torch.compile`.",
            "",
            "The errors of the log-density log p and of the entropy of a von Mises density are relative to max(1, "
            "|reference|). The error of d/dμ is relative to the reference. The error of d/dκ is relative to "
            "|cos(φ-μ) - 1| + 1 - A(κ), because d/dκ is a difference of these two terms; A(κ) is I₁(κ)/I₀(κ).",
            "",
            *accuracy_table(),
            "",
            "Two further functions of von Mises densities were compared with references. The largest relative error "
            "of the concentration κ that is computed from moments (eq. 3.5), for κ from 1e-8 to 1e12, is "
            f"{largest_error_from_moments():.1e}. The largest difference of the distribution function at κ = 1e30 "
            f"from the distribution function of a normal density is {largest_error_of_cdf():.1e}.",
            "",
            "## Entropy of mixtures",
            "",
            "The table gives the largest error of the computed entropy of random mixtures of K von Mises densities, "
            "compared with quadrature in 50 digits. The concentration κ is between 0 and 1e30, and equal or "
            "different for the components. The means are far apart, scattered by three widths of a component, or "
            "equal. About a tenth of the weights is 0. In float32, the reference is computed for the parameters as "
            "they are rounded to float32.",
            "",
            *mixture_table(),
            "",
            machine("torch", "numpy", "scipy", "mpmath")
            + " Command: `python -m benchmarks.densities.von_mises`.",
            "",
            *(line for heading in SPEEDS for line in (heading, "")),
        ]
    )


if __name__ == "__main__":
    page = Path(__file__).with_suffix(".md")
    sections = timed_sections()  # first, because it exits if the machine is not idle
    if sys.argv[1:] != ["--only", "times"]:
        write_page(__file__, report())
    for heading, section in sections.items():
        replace_section(page, heading, section)
