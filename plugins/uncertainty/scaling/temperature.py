"""Temperature scaling: every density is raised to the power 1/T, with one T fitted to the validation split."""

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.calibration.validation import nonempty_batches, predict_densities, require_numbers
from framework.data import Batch
from framework.distributions.tempering import temper
from framework.errors import count_of
from framework.model import Predictor
from framework.storage.weights import require_state
from framework.uncertainty import Uncertainty
from plugins.uncertainty.scaling.likelihood import Term, minimise, total

GRID = 17
"""Number of temperatures that are tried first; the fit starts at the best of them.

The likelihood of mixtures may have several maxima.
"""
_log = logging.getLogger(__name__)


class Temperature(Uncertainty):
    """Temperature scaling of densities p to p^(1/T), normalised, with the T of highest validation likelihood.

    For classes this divides logits by T (thesis eq. 2.19 with β = 0). The modes stay the same. Before `calibrate` T is
    1, which does not change the densities of the wrapped model. The fitted T is never worse than 1 on the validation
    split. T stays within its bounds for any targets: on a perfectly separable split, where the likelihood rises without
    end as T decreases, T stops at the bound, and the log says so.

    With `prior`, log T has a normal prior density around 0, and T has the highest posterior density. On a separable
    split of few samples, the likelihood rises by little as T decreases, because it is already close to its maximum at
    T = 1. The prior then keeps T near 1; many samples, or wrong predictions, outweigh it.

    Args:
        lower, upper: bounds of T.
        prior: standard deviation of the prior density of log T; None: no prior, so that T has the highest likelihood.

    Attributes:
        temperature: T, a float64 buffer.

    Raises:
        UserError: the validation split is empty, a likelihood is NaN (the message names the samples), or the power of
            the density is not known.
    """

    bibtex = "guo2017calibration"
    temperature: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        lower: Annotated[float, Field(gt=0, le=1)] = 0.05,
        upper: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 20.0,
        prior: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None,
    ) -> None:
        super().__init__()
        self.model = model()
        self.lower = lower
        self.upper = upper
        self.prior = prior
        self.register_buffer("temperature", torch.ones((), dtype=torch.float64))
        require_state(self, temperature=(lower, upper))

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the tempered density for each input."""
        return temper(self.model(inputs), self.temperature)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model, then fit the temperature."""
        kept_batches = nonempty_batches(batches, by="temperature")
        self.model.calibrate(kept_batches)
        predicted = predict_densities(self.model, kept_batches)
        fitted = fit(predicted, kept_batches, self.lower, self.upper, self.prior)
        self.temperature.fill_(fitted)
        rows = sum(len(batch["target"]) for batch in kept_batches)
        value = "most likely" if self.prior is None else "most probable"
        self.remark = (
            f"temperature: T = {fitted:.3g}, the {value} value for {count_of(rows, 'validation sample')}."
        )


def fit(
    predicted: Sequence[Distribution],
    batches: Sequence[Batch],
    lower: float,
    upper: float,
    prior: float | None = None,
) -> float:
    """Return the temperature T in [lower, upper] with the highest posterior density of log T.

    This T minimises the negative log-likelihood plus (log T / prior)² / 2, the negative logarithm of the normal prior
    density without its constant (maximum a posteriori; Bishop 2006, Pattern Recognition and Machine Learning, §1.2.5).

    If no temperature is better than 1, the result is 1. The negative log-likelihood of a target y is -log p(y)^(1/T) +
    log Z with the normalising constant Z of p^(1/T) (thesis eq. 2.19). Targets of probability 0 have probability 0 at
    any T: they are left out, and their number is logged.

    Args:
        predicted: densities of each batch.
        batches: batches, whose targets are read.
        lower: lower bound of T.
        upper: upper bound of T.
        prior: standard deviation of the prior density of log T; None for the T of highest likelihood.
    """
    targets = [batch["target"] for batch in batches]
    with torch.no_grad():
        log_probs = [density.log_prob(target) for density, target in zip(predicted, targets, strict=True)]
    known = torch.cat(log_probs).double()
    require_numbers(known, batches, "log-likelihood")
    possible = int((known > -math.inf).sum())
    if possible < len(known):
        _log.warning(
            "temperature: %d of %d validation targets have probability 0 at any temperature; the temperature is fitted "
            "to the others.",
            len(known) - possible,
            len(known),
        )
    if possible == 0:
        return 1.0
    terms = [
        _term(density, target, log_prob > -math.inf, possible)
        for density, target, log_prob in zip(predicted, targets, log_probs, strict=True)
    ]
    rounding = torch.finfo(log_probs[0].dtype).eps
    low, high = (torch.tensor([bound], dtype=torch.float64).log() for bound in (lower, upper))
    candidates = [
        torch.zeros(1, dtype=torch.float64),
        *torch.linspace(low.item(), high.item(), GRID, dtype=torch.float64).split(1),
    ]
    values = torch.stack([total(terms, candidate) for candidate in candidates])
    weight = 0.0 if prior is None else 1 / (2 * prior**2 * possible)
    penalised = values + torch.stack([weight * candidate.square().sum() for candidate in candidates]).to(
        values
    )
    if prior is not None:
        terms.append(lambda point: (weight * point.square().sum()).to(values))
    least = rounding * (1 + values[0].abs())
    if not (values - values[0]).abs().max() > 4 * least:
        _log.warning(
            "temperature: the validation likelihood is the same at any temperature, because every density is uniform; "
            "the temperature stays 1."
        )
        return 1.0
    start = candidates[int(penalised.nan_to_num(nan=math.inf).argmin())]
    best = minimise(terms, start, low, high, rounding=rounding)
    if values[0] - best.value <= least:
        return 1.0
    if best.active.item():
        _log.warning(
            "temperature: T stopped at its %s bound %g, where the likelihood of the validation split still rises: %s",
            *("upper", upper, "the wrapped model carries no information about the targets.")
            if best.active.item() > 0
            else (
                "lower",
                lower,
                "the split is perfectly separable, or too small. uncertainty.temperature.prior=1.0 keeps T near 1.",
            ),
        )
    return min(max(best.point.exp().item(), lower), upper)


def _term(density: Distribution, target: Tensor, possible: Tensor, count: int) -> Term:
    """Return one batch's part of the mean negative log-likelihood, as a function of log T.

    Args:
        density: densities of the batch.
        target: targets of the batch.
        possible: False for targets of probability 0, which are left out.
        count: number of targets of all batches that are not left out.
    """
    # the mode replaces a target of probability 0, whose infinite log-likelihood would give a gradient of 0 · ∞
    mask = possible.reshape(*possible.shape, *(1,) * (target.dim() - possible.dim()))
    value = target if bool(possible.all()) else torch.where(mask, target, density.mode)

    def term(point: Tensor) -> Tensor:
        log_prob = temper(density, point[0].exp()).log_prob(value).double()
        return -torch.where(possible, log_prob, 0.0).sum() / count

    return term
