"""Mean log-likelihood or its negative, with the standard error, from a running mean and sum of squared deviations."""

from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from framework.distributions.checks import refuse_nan
from framework.distributions.protocol import Estimate
from framework.errors import shorten
from framework.metric import Directions, Metric
from framework.prediction import Prediction

UNLIKELY = 20.0
"""Number of nats below the median log-likelihood of its batch at which a target of one number is reported."""


class Unlikely(NamedTuple):
    """Targets that are nearly impossible according to their predicted densities.

    Attributes:
        count: number of these targets.
        samples: number of all targets.
        gap: smallest reported distance from the median, nats (`unlikely_gap`).
        lowest: lowest log-likelihood, nats.
        index: number of this sample in the split.
        target: its target, in the user's unit.
    """

    count: int = 0
    samples: int = 0
    gap: float = UNLIKELY
    lowest: float = 0.0
    index: int = 0
    target: str = ""


class Moments(Metric):
    """Base class of the metrics of log-likelihood.

    The states are the moments of the log-likelihoods (`compute_moments`), and sums from which the sampling error is
    computed (`summarize_sampling`). A remark counts real-valued targets that are far less likely than the median of
    their batch (`unlikely_gap`), because a few such samples dominate the mean.
    """

    moments: Tensor
    sampling: Tensor

    def __init__(self) -> None:
        super().__init__()
        # a single state, because count, mean and squared deviations can only be merged together
        self.add_state("moments", torch.zeros(3, dtype=torch.float64), dist_reduce_fx=merge_moments)
        self.add_state("sampling", torch.zeros(5, dtype=torch.float64), dist_reduce_fx=merge_sampling)
        self.unlikely = Unlikely()

    def reset(self) -> None:
        super().reset()
        self.unlikely = Unlikely()

    def remarks(self) -> tuple[str, ...]:
        worst = self.unlikely
        if worst.count == 0:
            return ()
        return (
            f"log-likelihood: {worst.count} of {worst.samples} targets are more than {worst.gap:.3g} nats less likely "
            f"than the median; the least likely is test sample {worst.index}, target {worst.target}, with "
            f"{worst.lowest:.4g} nats. Its predicted density is far too narrow, or the target is wrong. For a "
            "table, such losses are bounded by heavier tails (density_head=student_t), by calibration "
            "(uncertainty=[folds]) and, for a target of several powers of ten, by predicting its logarithm.",
        )

    def add_samples(self, log_prob: Float[Tensor, "batch"], estimate: Estimate) -> None:
        """Add the log-likelihoods of a batch to the states, and the sampling errors in `estimate`."""
        self.moments = merge_moments(torch.stack([self.moments, compute_moments(log_prob)]))
        self.sampling = merge_sampling(torch.stack([self.sampling, summarize_sampling(estimate)]))


class LogLikelihood(Moments):
    """Mean log-likelihood of the targets, nats, with its standard error (thesis Tables 3.1 to 3.3).

    A target with density 0 has log-likelihood -inf; the mean is then -inf and the standard error NaN.

    If log_prob is a Monte Carlo estimate, the metric has additional results: the debiased mean, which is the mean
    without its first-order bias; the sampling error, which is the standard error due to sampling only; the mean and the
    largest number of samples per item; and the number of items that did not reach the requested tolerance. The debiased
    mean and the sampling error are NaN if the samples are not divided into several independent parts. For a density
    that does not declare whether its log_prob draws samples, the only additional result is the sampling error, which is
    NaN.
    """

    bibtex = "gneiting2007strictly"
    columns: ClassVar[dict[str, str]] = {"log_likelihood": "log-likelihood (nats)"}
    better: ClassVar[Directions] = {"log_likelihood": "higher"}

    def update(self, prediction: Prediction) -> None:
        self.add_samples(prediction.log_prob, prediction.estimate)
        self.unlikely = add_unlikely(self.unlikely, prediction)

    def compute(self) -> dict[str, Tensor]:
        return summary("log_likelihood", self.moments, self.sampling)


class NegativeLogLikelihood(Moments):
    """Mean negative log-likelihood of the targets, nats, with its standard error (thesis eq. 2.25 as a mean).

    It is the negative of `log_likelihood`, for tables in which lower is better, with the same additional results for
    densities whose log_prob is an estimate. A target with density 0 makes the mean infinite and the standard error NaN.

    Raises:
        UserError: log-likelihoods are NaN.
    """

    bibtex = "good1952rational"
    columns: ClassVar[dict[str, str]] = {"nll": "NLL (nats)"}
    better: ClassVar[Directions] = {"nll": "lower"}

    def update(self, prediction: Prediction) -> None:
        self.add_samples(
            refuse_nan(prediction.log_prob, "log-likelihoods of the targets"), prediction.estimate
        )
        self.unlikely = add_unlikely(self.unlikely, prediction)

    def compute(self) -> dict[str, Tensor]:
        results = summary("nll", self.moments, self.sampling)
        # subtract from 0, so that an NLL of zero is not -0
        return results | {name: 0 - results[name] for name in ("nll", "nll_debiased") if name in results}


def unlikely_gap(numbers: int) -> float:
    """Return the distance in nats from the median log-likelihood at which a target of several numbers is reported.

    The log-likelihood of a target of d numbers under a calibrated normal density is a constant minus half of a variable
    with the distribution χ²_d, which spreads more for larger d. The distance is exceeded with the same probability for
    each d; for one number it is UNLIKELY.
    """
    from scipy.special import chdtrc, chdtri

    probability = chdtrc(1, 2 * UNLIKELY + chdtri(1, 0.5))
    return float(chdtri(numbers, probability) - chdtri(numbers, 0.5)) / 2


def add_unlikely(unlikely: Unlikely, prediction: Prediction) -> Unlikely:
    """Return `unlikely` with the targets of a batch; other targets than real numbers of the test split are ignored."""
    log_prob = prediction.log_prob.detach()
    if len(log_prob) == 0 or prediction.split != "test" or prediction.target.dim() != 2:
        return unlikely
    samples = unlikely.samples + len(log_prob)
    below = log_prob.median() - log_prob
    if not bool((below > UNLIKELY).any()):  # the gap of several numbers is larger
        return unlikely._replace(samples=samples)
    gap = unlikely_gap(prediction.target.shape[1])
    count = unlikely.count + int((below > gap).sum())
    row = int(log_prob.argmin())
    lowest = float(log_prob[row])
    if count == unlikely.count or (unlikely.count and lowest >= unlikely.lowest):
        return unlikely._replace(count=count, samples=samples)
    index = prediction.batch["index"][row] if "index" in prediction.batch else row
    target = shorten(", ".join(f"{value:.4g}" for value in prediction.target[row].tolist()), 80)
    return Unlikely(count, samples, gap, lowest, int(index), target)


def summary(
    name: str, moments: Float[Tensor, "3"], sampling: Float[Tensor, "5"]
) -> dict[str, Float[Tensor, ""]]:
    """Return the results of a metric: the mean under the key `name`, and its standard error under `<name>_sem`.

    If log_prob is a Monte Carlo estimate, the results of the sampling are returned too.

    Args:
        name: key of the mean.
        moments: moments as returned by `compute_moments`.
        sampling: sums as returned by `summarize_sampling`.
    """
    count, mean, squares = moments
    has_samples = count > 0
    results = {
        name: torch.where(has_samples, mean, torch.nan),
        # σ/√n with the sample variance σ² = Σ(x - x̄)² / (n - 1); it is undefined for one sample: 0/0
        f"{name}_sem": torch.where(has_samples, (squares / (count - 1) / count).sqrt(), torch.nan),
    }
    debiased, variance, samples, above, most = sampling
    if samples == 0:
        return results if variance == 0 or not has_samples else results | {f"{name}_mc_error": variance}
    return results | {
        f"{name}_debiased": debiased / count,
        # variance of a mean of independently sampled items
        f"{name}_mc_error": variance.sqrt() / count,
        "samples_mean": samples / count,
        "samples_max": most,
        "items_above_tolerance": above,
    }


def compute_moments(values: Float[Tensor, "samples"]) -> Float[Tensor, "3"]:
    """Return the number n of values x, their mean, and Σ(x - mean)², in float64; zeros if there are no values."""
    values = values.detach().double()
    count = values.new_tensor(len(values))
    if len(values) == 0:
        return values.new_zeros(3)
    mean = values.mean()
    return torch.stack([count, mean, (values - mean).square().sum()])


def summarize_sampling(estimate: Estimate) -> Float[Tensor, "5"]:
    """Return sums over the items of an estimate of log-likelihoods, and a maximum, float64.

    Returns:
        Sum of debiased log-likelihoods, sum of squared standard errors, number of samples, number of items above the
        tolerance, largest number of samples of an item.
    """
    if estimate.samples.numel() == 0:
        return torch.zeros(5, dtype=torch.float64, device=estimate.samples.device)
    return torch.stack(
        [
            estimate.debiased.detach().double().sum(),
            estimate.standard_error.double().square().sum(),
            estimate.samples.double().sum(),
            estimate.unresolved.double().sum(),
            estimate.samples.double().max(),
        ]
    )


def merge_sampling(parts: Float[Tensor, "parts 5"]) -> Float[Tensor, "5"]:
    """Return what `summarize_sampling` gives for all items, from its results for disjoint parts of the items."""
    return torch.cat([parts[:, :4].sum(0), parts[:, 4:].amax(0)])


def merge_moments(parts: Float[Tensor, "parts 3"]) -> Float[Tensor, "3"]:
    """Return the moments of all samples, from the moments of disjoint parts (Chan, Golub & LeVeque 1983, eq. 2.1).

    The moments are those that `compute_moments` returns.
    Unlike a sum of squares, this method stays exact if the mean is much larger than the deviation.
    """
    parts = parts[parts[:, 0] > 0]
    count, mean, squares = parts.unbind(-1)
    total = count.sum()
    if total == 0:
        return parts.new_zeros(3)
    # a weighted mean (not mean + correction) is -inf, and not NaN, if one part is -inf
    middle = (count * mean).sum() / total
    between = (count * (mean - middle).square()).sum()
    return torch.stack([total, middle, squares.sum() + between])
