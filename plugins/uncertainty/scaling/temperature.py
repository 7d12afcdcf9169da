"""Temperature scaling: all densities are raised to the inverse of one number, fitted to the validation set."""

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
from framework.model import Predictor
from framework.storage.weights import require_state
from framework.uncertainty import Uncertainty
from plugins.uncertainty.scaling.likelihood import Term, minimise, total

GRID = 17
"""Number of temperatures tried before the fit, which starts at the best, since mixtures may have several maxima."""
_log = logging.getLogger(__name__)


class Temperature(Uncertainty):
    """Every density p becomes p^(1/T), normalised, with the T of highest validation likelihood.

    For classes this divides logits by T (thesis eq. 2.19 with β = 0); it changes no mode. Before `calibrate` T is 1 and
    the densities are those of the wrapped model. On the validation set T is never worse than 1. It stays within its
    bounds for any labels: on a perfectly separable set, where the likelihood rises without end, it stops at the bound,
    and the log says so.

    Args:
        lower, upper: bounds of T.

    Attributes:
        temperature: T, a float64 buffer.

    Raises:
        UserError: an empty validation set, a likelihood that is NaN (its samples are named), or a density that has no
            known power.
    """

    bibtex = """@inproceedings{guo2017calibration,
  author    = {Guo, Chuan and Pleiss, Geoff and Sun, Yu and Weinberger, Kilian Q.},
  title     = {On Calibration of Modern Neural Networks},
  booktitle = {International Conference on Machine Learning},
  pages     = {1321--1330},
  year      = {2017}
}"""
    temperature: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        lower: Annotated[float, Field(gt=0, le=1)] = 0.05,
        upper: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 20.0,
    ) -> None:
        super().__init__()
        self.knobs = {}
        self.model = model()
        self.lower = lower
        self.upper = upper
        self.register_buffer("temperature", torch.ones((), dtype=torch.float64))
        require_state(self, temperature=(lower, upper))

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the tempered density for each input."""
        return temper(self.model(inputs), self.temperature)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model, then fit the temperature."""
        seen = nonempty_batches(batches, by="temperature")
        self.model.calibrate(seen)
        found = fit(predict_densities(self.model, seen), seen, self.lower, self.upper)
        self.temperature.fill_(found)
        rows = sum(len(batch["target"]) for batch in seen)
        self.remark = f"temperature: {found:.3g}, the likeliest of {rows} validation rows."


def fit(predicted: Sequence[Distribution], batches: Sequence[Batch], lower: float, upper: float) -> float:
    """Return T in [lower, upper] with the least mean of -log p^(1/T)(y) + log Z (eq. 2.19); 1 if none is better.

    Targets with probability 0 have it at any T: they are counted in the log and left out.
    """
    targets = [batch["target"] for batch in batches]
    with torch.no_grad():
        log_probs = [density.log_prob(target) for density, target in zip(predicted, targets, strict=True)]
    known = torch.cat(log_probs).double()
    require_numbers(known, batches, "log-likelihood")
    possible = int((known > -math.inf).sum())
    if possible < len(known):
        _log.warning(
            "temperature: %d of %d validation targets have probability 0 at any; it is fitted to the others.",
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
        *torch.linspace(low.item(), high.item(), GRID).split(1),
    ]
    values = torch.stack([total(terms, candidate) for candidate in candidates])
    least = rounding * (1 + values[0].abs())
    if not (values - values[0]).abs().max() > 4 * least:
        _log.warning(
            "temperature: the validation likelihood is the same at any (every density is uniform); it stays 1."
        )
        return 1.0
    start = candidates[int(values.nan_to_num(nan=math.inf).argmin())]
    best = minimise(terms, start, low, high, rounding=rounding)
    if values[0] - best.value <= least:
        return 1.0
    if best.active.item():
        _log.warning(
            "temperature: stopped at its %s bound %g, where the likelihood of the validation set still rises: %s.",
            *("upper", upper, "what is wrapped knows nothing of the targets")
            if best.active.item() > 0
            else ("lower", lower, "the set is perfectly separable, or too small to tell"),
        )
    return min(max(best.point.exp().item(), lower), upper)


def _term(density: Distribution, target: Tensor, possible: Tensor, count: int) -> Term:
    """Return the function of log T that gives this batch's part of the mean negative log-likelihood."""
    # the mode replaces a target of probability 0: an infinite value would give a gradient of 0 · ∞
    mask = possible.reshape(*possible.shape, *(1,) * (target.dim() - possible.dim()))
    value = target if bool(possible.all()) else torch.where(mask, target, density.mode)

    def term(point: Tensor) -> Tensor:
        log_prob = temper(density, point[0].exp()).log_prob(value).double()
        return -torch.where(possible, log_prob, 0.0).sum() / count

    return term
