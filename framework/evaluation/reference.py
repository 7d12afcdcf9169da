"""Error of log-likelihoods at a value of a knob, compared with a reference at a far more expensive value."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

COLUMNS = {
    "error_nats": "error (nats)",
    "bias_nats": "bias (nats)",
    "sample_error_nats": "one sample's error (nats)",
    "log_likelihood_nats": "log-likelihood (nats)",
}
"""Headings, in tables, of numbers that `errors` returns, by key."""
BETTER: Mapping[str, Literal["higher", "lower"]] = {
    "error_nats": "lower",
    "bias_nats": "lower",
    "sample_error_nats": "lower",
}
"""Direction in which each error is better."""

LogProbs = Callable[[int, int], Tensor]
"""Function that returns the log-likelihoods of all samples: (value of the knob, seed) → (samples,), nats."""


@dataclass(frozen=True)
class Reference:
    """Log-likelihoods with which other log-likelihoods are compared.

    Attributes:
        value: value of the knob.
        log_probs: for each sample, the logarithm of the density averaged over the repeats, nats.
        mean: mean of `log_probs` over the samples.
        standard_error: standard error of `mean` over the repeats (jackknife), nats; differences below it are not
            meaningful.
        repeats: number of seeds.
    """

    value: int
    log_probs: Float[Tensor, "samples"]
    mean: float
    standard_error: float
    repeats: int


def reference_value(log_probs: LogProbs, value: int, seeds: Sequence[int]) -> Reference:
    """Return the log-likelihoods at a large value of the knob, averaged over seeds.

    The densities of the seeds are averaged, not their logarithms. If the knob counts Monte Carlo samples, this equals
    one estimate with len(seeds) times as many samples, and the bias of the logarithm (Jensen) shrinks accordingly. The
    standard error is the jackknife's over the seeds, sqrt((R - 1)/R Σ_r (θ_(r) - θ_(·))²) (Efron & Tibshirani 1993, eq.
    11.5); R is the number of seeds, θ_(r) the mean log-likelihood without seed r, and θ_(·) the mean of all θ_(r).

    Args:
        log_probs: function of a value of the knob and a seed that returns the log-likelihood of each sample.
        value: the large value of the knob.
        seeds: at least two seeds.

    Raises:
        ValueError: a log-likelihood is not finite, so it cannot serve as a reference.
    """
    per_seed = torch.stack([log_probs(value, seed) for seed in seeds]).double()  # (repeats, samples)
    pooled = torch.logsumexp(per_seed, 0) - math.log(len(seeds))
    not_finite = (~pooled.isfinite()).nonzero()
    if len(not_finite):
        raise ValueError(
            f"The reference log-likelihood of sample {int(not_finite[0])} is {pooled[not_finite[0]].item()} "
            f"({len(not_finite)} samples have such a value), but must be finite. Set mode.reference to a larger "
            "value of the knob, or correct the density head."
        )
    left_out = torch.stack(
        [torch.cat([per_seed[:r], per_seed[r + 1 :]]).logsumexp(0).mean() for r in range(len(seeds))]
    )
    spread = (left_out - left_out.mean()).square().sum() * (len(seeds) - 1) / len(seeds)
    return Reference(value, pooled, float(pooled.mean()), float(spread.sqrt()), len(seeds))


def errors(log_probs: LogProbs, value: int, seeds: Sequence[int], reference: Reference) -> dict[str, float]:
    """Return the errors of log-likelihoods at one value of the knob, nats; infinite if a log-likelihood is infinite.

    "error_nats" is the root mean square, over the seeds, of the mean log-likelihood minus the reference. "bias_nats" is
    the absolute value of the mean of these differences over the seeds. "sample_error_nats" is the root mean square,
    over seeds and samples, of one sample's log-likelihood minus its reference, which is the typical error for a single
    sample. "log_likelihood_nats" is averaged over samples and seeds. The standard errors "error_nats_sem" and
    "log_likelihood_nats_sem" are over the seeds, NaN for a single seed. The standard error of a root mean square
    sqrt(m) is that of m divided by 2 sqrt(m) (delta method).

    Args:
        log_probs: function of a value of the knob and a seed that returns the log-likelihood of each sample.
        value: value of the knob.
        seeds: seeds of the random numbers.
        reference: log-likelihoods at a far more expensive value of the knob, of the same samples.
    """
    per_seed = torch.stack([log_probs(value, seed) for seed in seeds]).double()  # (repeats, samples)
    means = per_seed.mean(1)
    squares = (means - reference.mean).square()
    error = float(squares.mean().sqrt())
    return {
        "error_nats": error,
        "error_nats_sem": _standard_error(squares) / (2 * error) if error > 0 else 0.0,
        "bias_nats": abs(float(means.mean()) - reference.mean),
        "sample_error_nats": float((per_seed - reference.log_probs).square().mean().sqrt()),
        "log_likelihood_nats": float(means.mean()),
        "log_likelihood_nats_sem": _standard_error(means),
    }


def _standard_error(values: Tensor) -> float:
    """Return the standard error of the mean of independent values; NaN for a single value."""
    return float(values.std() / len(values) ** 0.5) if len(values) > 1 else math.nan
