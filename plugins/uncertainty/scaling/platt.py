"""Platt scaling: a slope and biases of log-probabilities, fitted to the validation split."""

import logging
from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.calibration.validation import nonempty_batches, predict_densities, require_numbers
from framework.data import Batch
from framework.distributions.tempering import RescaledClasses, log_probabilities
from framework.errors import count_of
from framework.model import Predictor
from framework.storage.weights import FINITE, require_state
from framework.target import Target
from framework.uncertainty import Uncertainty
from plugins.uncertainty.scaling.likelihood import minimise

STEEPEST = 20.0
"""Largest slope; the smallest is 0."""
LARGEST_BIAS = 50.0
"""Largest bias of a class, nats, before the mean over classes is subtracted."""
LEAST = -1e5
"""Smallest log-probability, nats; smaller ones and -∞ are replaced by this number."""
_log = logging.getLogger(__name__)


class Platt(Uncertainty):
    """Platt scaling of class probabilities: log-probabilities l become a·l + b, normalised (thesis eq. 2.18-2.19).

    The slope a ≥ 0 is common to all classes, and b holds one bias for each class; the biases sum to 0. For two classes
    this is a slope and a bias of the log-odds. Eq. 2.18 of the thesis multiplies the network's output probability by a.
    Here, as in Platt 1999 and Guo et al. 2017, a multiplies the log-odds, so that a = 1 and b = 0 change nothing; a and
    b have these values before `calibrate`. The wrapped model may return any density over classes, also a mixture.

    A slope below 0 would reverse the order of the classes. If the labels contradict the wrapped model, the slope stops
    at 0, and the predicted probability of a class is then its share of the validation labels, for every input. Slope
    and biases have upper bounds too. The log says if a bound is reached.

    Args:
        smoothing: whether to fit to smoothed labels, as if there were one more sample of each class: (N₊+1)/(N₊+2) and
            1/(N₋+2) for two classes (Platt 1999, §2.2). The fit is then finite also on a split that is separable or
            has only one class.

    Attributes:
        slope: a, a float64 buffer.
        biases: b, (class,), nats, a float64 buffer.

    Raises:
        ConfigError: the target is not a class.
        UserError: the validation split is empty, or a likelihood is NaN (the message names the samples).
    """

    bibtex = "platt1999probabilistic"
    slope: Tensor
    biases: Tensor

    def __init__(self, model: Callable[[], Predictor], target: Target, *, smoothing: bool = True) -> None:
        super().__init__()
        target.require("class", by="uncertainty platt")
        self.model = model()
        self.smoothing = smoothing
        self.register_buffer("slope", torch.ones((), dtype=torch.float64))
        self.register_buffer("biases", torch.zeros(len(target.names), dtype=torch.float64))
        require_state(self, slope=(0.0, STEEPEST), biases=FINITE)

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the rescaled class probabilities for each input."""
        density = self.model(inputs)
        # the trace of an exported model depends on no value
        if not torch.compiler.is_exporting() and self.slope == 1 and not self.biases.any():
            return density
        log_prob = log_probabilities(density)
        logits = self.slope * log_prob.double().clamp(min=LEAST) + self.biases
        return RescaledClasses(logits.log_softmax(-1).to(log_prob.dtype), density, self.slope)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model, then fit slope and biases."""
        kept_batches = nonempty_batches(batches, by="platt")
        self.model.calibrate(kept_batches)
        predicted = predict_densities(self.model, kept_batches)
        log_prob = torch.cat([log_probabilities(density) for density in predicted]).detach().double()
        require_numbers(log_prob.sum(-1), kept_batches, "class probabilities")
        label = torch.cat([batch["target"] for batch in kept_batches])
        slope, biases = fit(log_prob, label, smoothing=self.smoothing)
        self.slope.fill_(slope)
        self.biases.copy_(biases)
        rows = count_of(len(label), "validation sample")
        self.remark = f"platt: slope {slope:.3g}, the most likely value for {rows}."


def fit(
    log_prob: Float[Tensor, "sample label"], label: Int[Tensor, "sample"], *, smoothing: bool
) -> tuple[float, Float[Tensor, "label"]]:
    """Return the slope and the biases with the smallest mean cross-entropy to the labels (thesis eq. 2.19).

    The problem is convex.

    Args:
        log_prob: log-probabilities of the classes, nats, float64.
        label: true class of each sample.
        smoothing: whether to smooth the labels first, as if there were one more sample of each class (`targets`).
    """
    classes = log_prob.shape[-1]
    wanted = targets(label, classes, smoothing=smoothing)
    heights = log_prob.clamp(min=LEAST)
    heights = heights - heights.mean(-1, keepdim=True)
    # divided by their root mean square, so that slope and biases have similar magnitudes for the minimiser
    unit = heights.square().mean().sqrt().clamp(min=torch.finfo(torch.float64).eps)
    heights = heights / unit

    def cross_entropy(point: Tensor) -> Tensor:
        logits = point[0] * heights + point[1:]
        return -(wanted * logits.log_softmax(-1)).sum(-1).mean()

    bound = torch.full((classes + 1,), LARGEST_BIAS, dtype=torch.float64, device=log_prob.device)
    lower, upper = -bound, bound.clone()
    lower[0], upper[0] = 0.0, STEEPEST * unit
    start = torch.zeros_like(bound)
    start[0] = unit
    best = minimise([cross_entropy], start, lower, upper)
    slope = min((best.point[0] / unit).item(), STEEPEST)
    biases = best.point[1:] - best.point[1:].mean()
    if best.active[0] < 0:
        _log.warning(
            "platt: the slope stopped at 0, because the validation labels contradict the wrapped model; every "
            "prediction is now the share of each class."
        )
    elif best.active.any():
        _log.warning(
            "platt: the %s stopped at its bound %g, where the likelihood of the validation split still rises: the "
            "split is perfectly separable, or lacks a class. Set uncertainty.platt.smoothing=true.",
            *("slope", STEEPEST) if best.active[0] else ("bias of a class", LARGEST_BIAS),
        )
    return slope, biases


def targets(label: Int[Tensor, "sample"], classes: int, *, smoothing: bool) -> Float[Tensor, "sample label"]:
    """Return the class probabilities to which the scaling is fitted, one row for each sample.

    Without smoothing they are 1 for the label of the sample and 0 for other classes. With smoothing they are
    (N_k+1)/(N_k+K) for the label k, and 1/(N_k+K) for each other class (for two classes Platt 1999, §2.2). N_k is the
    number of samples with the label k, and K the number of classes.
    """
    exact = torch.nn.functional.one_hot(label, classes).double()
    if not smoothing:
        return exact
    count = exact.sum(0)[label].unsqueeze(-1)
    return (exact * count + 1) / (count + classes)
