"""Mean log-likelihood or its negative, with the standard error, from a running mean and sum of squared deviations."""

from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from framework.distributions.checks import refuse_nan
from framework.distributions.protocol import Estimate
from framework.metric import Metric
from framework.prediction import Prediction


class Moments(Metric):
    """Base class of both metrics: moments of log-likelihoods, and sums that describe the error due to sampling."""

    moments: Tensor
    sampling: Tensor

    def __init__(self) -> None:
        super().__init__()
        # One state, not three: count, mean and squared deviations can only be merged together.
        self.add_state("moments", torch.zeros(3, dtype=torch.float64), dist_reduce_fx=merged_moments)
        self.add_state("sampling", torch.zeros(5, dtype=torch.float64), dist_reduce_fx=merged_sampling)

    def add_samples(self, log_prob: Float[Tensor, "batch"], estimate: Estimate) -> None:
        """Add the log-likelihoods of a batch and what their estimate says of the sampling."""
        self.moments = merged_moments(torch.stack([self.moments, moments_of(log_prob)]))
        self.sampling = merged_sampling(torch.stack([self.sampling, sampling_of(estimate)]))


class LogLikelihood(Moments):
    """Mean log-likelihood of the targets, nats, with its standard error (thesis Tables 3.1 to 3.3).

    A target that the density rules out has log-likelihood -inf; the mean is then -inf and the standard error NaN.

    Where log_prob is a Monte Carlo estimate, the metric also reports the mean without its first-order bias, the
    standard error due to the sampling alone, the mean and the largest number of samples per item, and how many items
    did not reach the requested tolerance. Debiased mean and sampling error are NaN where they cannot be estimated from
    a single replicate. For a density that has not declared whether its log_prob draws samples, only the sampling error
    is reported, as NaN.
    """

    bibtex = """@article{gneiting2007strictly,
  author  = {Gneiting, Tilmann and Raftery, Adrian E.},
  title   = {Strictly Proper Scoring Rules, Prediction, and Estimation},
  journal = {Journal of the American Statistical Association},
  volume  = {102},
  number  = {477},
  pages   = {359--378},
  year    = {2007}
}"""
    columns: ClassVar[dict[str, str]] = {"log_likelihood": "log-likelihood (nats)"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"log_likelihood": "higher"}

    def update(self, prediction: Prediction) -> None:
        self.add_samples(prediction.log_prob, prediction.estimate)

    def compute(self) -> dict[str, Tensor]:
        return summary("log_likelihood", self.moments, self.sampling)


class NegativeLogLikelihood(Moments):
    """Mean negative log-likelihood of the targets, nats, with its standard error (thesis eq. 2.25 as a mean).

    It is the negative of `log_likelihood`, for tables in which lower is better, with the same further numbers for
    densities whose log_prob is an estimate. A target that the density rules out makes the mean infinite and the
    standard error NaN.

    Raises:
        UserError: log-likelihoods are NaN; the message says how many.
    """

    bibtex = """@article{good1952rational,
  author  = {Good, Irving John},
  title   = {Rational Decisions},
  journal = {Journal of the Royal Statistical Society: Series B},
  volume  = {14},
  number  = {1},
  pages   = {107--114},
  year    = {1952}
}"""
    columns: ClassVar[dict[str, str]] = {"nll": "NLL (nats)"}
    better: ClassVar[dict[str, Literal["higher", "lower"]]] = {"nll": "lower"}

    def update(self, prediction: Prediction) -> None:
        self.add_samples(
            refuse_nan(prediction.log_prob, "log-likelihoods of the targets"), prediction.estimate
        )

    def compute(self) -> dict[str, Tensor]:
        found = summary("nll", self.moments, self.sampling)
        # subtract from 0, so that the NLL of certain and right predictions is not -0
        return found | {name: 0 - found[name] for name in ("nll", "nll_debiased") if name in found}


def summary(
    name: str, moments: Float[Tensor, "3"], sampling: Float[Tensor, "5"]
) -> dict[str, Float[Tensor, ""]]:
    """Return mean and standard error under `name`; where log_prob was estimated, also the effect of the sampling."""
    count, mean, squares = moments
    seen = count > 0
    found = {
        name: torch.where(seen, mean, torch.nan),
        # σ/√n with the sample variance σ² = Σ(x - x̄)² / (n - 1); it is undefined for one sample: 0/0
        f"{name}_sem": torch.where(seen, (squares / (count - 1) / count).sqrt(), torch.nan),
    }
    debiased, variance, samples, above, most = sampling
    if samples == 0:
        return found if variance == 0 or not seen else found | {f"{name}_mc_error": variance}
    return found | {
        f"{name}_debiased": debiased / count,
        # the items are sampled independently: this is the variance of a mean
        f"{name}_mc_error": variance.sqrt() / count,
        "samples_mean": samples / count,
        "samples_max": most,
        "items_above_tolerance": above,
    }


def moments_of(values: Float[Tensor, "samples"]) -> Float[Tensor, "3"]:
    """Return (n, mean, Σ(x - mean)²) in float64; zeros if there are no values."""
    values = values.detach().double()
    count = values.new_tensor(len(values))
    if len(values) == 0:
        return values.new_zeros(3)
    mean = values.mean()
    return torch.stack([count, mean, (values - mean).square().sum()])


def sampling_of(found: Estimate) -> Float[Tensor, "5"]:
    """Return Σ debiased log-likelihoods, Σ squared errors, Σ samples, items above tolerance, most samples; float64."""
    if found.samples.numel() == 0:
        return torch.zeros(5, dtype=torch.float64, device=found.samples.device)
    return torch.stack(
        [
            found.debiased.detach().double().sum(),
            found.standard_error.double().square().sum(),
            found.samples.double().sum(),
            found.unresolved.double().sum(),
            found.samples.double().max(),
        ]
    )


def merged_sampling(parts: Float[Tensor, "parts 5"]) -> Float[Tensor, "5"]:
    """Return the sampling numbers of all items, from those of disjoint parts."""
    return torch.cat([parts[:, :4].sum(0), parts[:, 4:].amax(0)])


def merged_moments(parts: Float[Tensor, "parts 3"]) -> Float[Tensor, "3"]:
    """Return the moments of all samples, from those of disjoint parts (Chan, Golub & LeVeque 1983, eq. 2.1).

    The method stays exact where the mean is large against the deviation and a sum of squares would lose the variance.
    """
    parts = parts[parts[:, 0] > 0]
    count, mean, squares = parts.unbind(-1)
    total = count.sum()
    if total == 0:
        return parts.new_zeros(3)
    # a weighted mean, not mean + correction: it is -inf, not NaN, if one part is -inf
    middle = (count * mean).sum() / total
    between = (count * (mean - middle).square()).sum()
    return torch.stack([total, middle, squares.sum() + between])
