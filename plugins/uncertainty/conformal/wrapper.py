"""Split conformal prediction: for any model, sets that hold the target with a stated probability."""

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.calibration.module_flags import evaluation_mode
from framework.calibration.validation import nonempty_batches, predict_densities, require_numbers
from framework.data import Batch
from framework.distributions.protocol import median
from framework.errors import ConfigError, UserError, count_of
from framework.model import Predictor
from framework.storage.weights import FINITE, require_state
from framework.target import Target
from framework.uncertainty import SelfTraining, Uncertainty, held_out, self_training
from plugins.uncertainty.conformal.cross_validation import (
    SAMPLES,
    IntervalSet,
    centres_of_parts,
    cross_validation_interval,
)
from plugins.uncertainty.conformal.prediction_set import PredictionSet, Score

SEED = 71
"""Seed of the random split into halves."""
NEAR = 0.03
"""Deviation from the stated coverage that should not be exceeded for 90 % of all validation splits.

If the validation split has too few samples for this, `coverage_remark` names the number that would suffice.
"""
NINETY = 1.645
"""Distance from the mean, in standard deviations, within which a normal density has the probability 0.9."""
MOST_RESIDUALS = 20_000
"""Largest number of samples whose residuals are stored for "cv_plus"; for so many, split conformal sets are as good."""
ROUNDING = 1e-5
"""Amount by which a threshold that several scores share is raised, relative to their unit (`raise_shared`).

Equal inputs, such as rows of a table of categories, have equal scores. A network computes them in float32, and the last
bits depend on the batch size and the device. Without this amount, sets of such inputs could lose all targets whose
score equals the threshold.
"""
_log = logging.getLogger(__name__)


class Conformal(Uncertainty):
    """Unchanged densities, each with a prediction set that holds the target with probability 1 - α.

    For data that is exchangeable with the validation split, a new target lies in its set with a probability of at least
    1 - α, and of at most 1 - α + 1/(n + 1) if no two of the n scores are equal. This probability is an average over
    targets and validation splits, for any model, however wrong (Vovk, Gammerman & Shafer 2005, §4.1). The bounds do not
    hold for each input separately. Use this wrapper as the outermost one: a wrapper around it keeps the densities and
    drops the sets, except for `feature_score`, which keeps both.

    The wrapped model is calibrated on a random half of the validation split, which is always the same half. The
    threshold is fitted to the other half, because scores of samples to which a temperature was fitted give no
    guarantee. Before `calibrate` every set holds all values.

    Args:
        miscoverage: α, the share of targets that may lie outside.
        score: "density": one level of density for all inputs, which gives the smallest sets on average; "mass": one
            probability for all inputs, which gives larger sets where the model is uncertain; "quantiles", for one real
            number: the central interval of probability 1 - α, with both ends moved by one distance for all inputs
            (conformalised quantile regression; Romano, Patterson & Candès 2019). "cv_plus", for one real number around
            a wrapper that trains models on parts of the samples (`folds`): CV+ intervals from the medians of these
            models and the residuals of all samples (Barber et al. 2021). They hold the target with a probability of
            at least 1 - 2α - √(2/n) for n samples, and of about 1 - α if the models hardly depend on single samples.

    Attributes:
        threshold: the largest score in a set, nats (for "quantiles" in the unit of the target), a float64 buffer.
        residuals, parts, count: for "cv_plus", the residual and the part of each sample, and their number, buffers.

    Raises:
        ConfigError: the score is "quantiles" or "cv_plus", and the target is not one real number; or it is "cv_plus",
            and no wrapper inside trains models on parts of the samples, or there are too many samples.
        UserError: there are fewer than 2 validation samples, or a score is NaN (the message names the samples).
    """

    bibtex = (
        "vovk2005algorithmic, sadinle2019least, romano2020classification, romano2019conformalized, "
        "barber2021predictive"
    )
    threshold: Tensor
    residuals: Tensor
    parts: Tensor
    count: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        target: Target,
        *,
        miscoverage: Annotated[float, Field(gt=0, lt=1)] = 0.1,
        score: Score | Literal["cv_plus"] = "density",
    ) -> None:
        super().__init__()
        self.model = model()
        self.miscoverage = miscoverage
        self.score: Score | Literal["cv_plus"] = score
        if score == "cv_plus":
            target.require("real", by="uncertainty.conformal.score=cv_plus")
            parted_wrapper(self.model)
            if len(target.names) != 1:
                raise ConfigError(
                    f"uncertainty.conformal.score=cv_plus gives intervals of one real number, but the target is "
                    f"{target.listed_names}. Choose score=density or score=mass."
                )
            self.register_buffer("residuals", torch.zeros(MOST_RESIDUALS, dtype=torch.float64))
            self.register_buffer("parts", torch.zeros(MOST_RESIDUALS, dtype=torch.int64))
            self.register_buffer("count", torch.zeros((), dtype=torch.int64))
            last = float(parted_wrapper(self.model).part_count - 1)
            require_state(self, residuals=FINITE, parts=(0.0, last), count=(0.0, float(MOST_RESIDUALS)))
        self.register_buffer("threshold", torch.tensor(math.inf, dtype=torch.float64))
        require_state(self, threshold=(-math.inf, math.inf))

    def forward(self, inputs: Tensor) -> PredictionSet | IntervalSet:
        """Return the density for each input with its prediction set."""
        if self.score == "cv_plus":
            centres = centres_of_parts(self.model, parted_wrapper(self.model), inputs)
            known = slice(int(self.count))
            residuals = self.residuals[known].double()
            ends = cross_validation_interval(centres, residuals, self.parts[known], self.miscoverage)
            return IntervalSet(self.model(inputs), *ends, 1 - self.miscoverage)
        return PredictionSet(self.model(inputs), self.threshold, self.score, 1 - self.miscoverage)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped model on one half of the samples, and fit the threshold to the other half.

        With "cv_plus" all samples calibrate the wrapped model, and the residuals of all samples are stored.
        """
        if self.score == "cv_plus":
            self._store_residuals(nonempty_batches(batches, by="conformal"))
            return
        model_half, own_half = split_in_halves(nonempty_batches(batches, by="conformal"))
        if not own_half:
            raise UserError(
                "uncertainty conformal shares the validation split with the wrapped model, so that at least 2 samples "
                "are required, but got one sample. Give the data set a larger validation split."
            )
        self.model.calibrate(model_half)
        score = self.score
        sets = [
            PredictionSet(density, self.threshold, score, 1 - self.miscoverage)
            for density in predict_densities(self.model, own_half)
        ]
        scores = torch.cat(
            [
                prediction_set.scores(batch["target"])
                for prediction_set, batch in zip(sets, own_half, strict=True)
            ]
        )
        require_numbers(scores, own_half, "score")
        targets = torch.cat([batch["target"] for batch in own_half])
        unit = float(targets.double().std(correction=0)) if score == "quantiles" else 1.0
        self.threshold.fill_(raise_shared(threshold(scores, self.miscoverage), scores, unit))
        self.remark = coverage_remark(len(scores), self.miscoverage)
        if self.threshold.isinf():
            _log.warning(
                "conformal: %d validation samples are too few to choose sets that miss at most a share of %g of the "
                "targets, so every set holds all values. %d samples are enough if every density gives each target a "
                "probability above 0.",
                len(scores),
                self.miscoverage,
                _least(self.miscoverage),
            )

    @torch.no_grad()
    def _store_residuals(self, batches: Sequence[Batch]) -> None:
        wrapper = parted_wrapper(self.model)
        self.model.calibrate(batches)
        if not all("row" in batch for batch in batches):
            self.count.fill_(0)
            self.remark = (
                "conformal: every set holds all values, because score=cv_plus needs the samples on which the models "
                "were trained: each residual is computed by the models that did not see the sample. Train the model "
                "with this wrapper (uncertainty=[folds,conformal]), or choose another score for mode=calibrate."
            )
            _log.warning("%s", self.remark)
            return
        residuals, parts = [], []
        with evaluation_mode(self.model):
            for batch in batches:
                with held_out(self.model, batch):
                    centre = median(self.model(batch["input"]), SAMPLES)
                residuals.append((batch["target"].double() - centre.double()).abs().squeeze(-1))
                parts.append(wrapper.part_of(batch["row"]).to(self.parts))
        errors = torch.cat(residuals)
        require_numbers(errors, batches, "residual")
        if len(errors) > MOST_RESIDUALS:
            raise ConfigError(
                f"uncertainty.conformal.score=cv_plus stores the residuals of at most {MOST_RESIDUALS:,} samples, but "
                f"there are {len(errors):,}. Choose score=density, mass or quantiles."
            )
        self.residuals[: len(errors)] = errors
        self.parts[: len(errors)] = torch.cat(parts)
        self.count.fill_(len(errors))
        bound = 1 - 2 * self.miscoverage - math.sqrt(2 / len(errors))
        self.remark = (
            f"conformal: CV+ intervals from the residuals of {count_of(len(errors), 'sample')}. They hold at least "
            f"{100 * max(0.0, bound):.3g} % of the targets if no model uses the samples that it left out, "
            f"and in practice about {100 * (1 - self.miscoverage):g} %."
        )


def parted_wrapper(model: Predictor) -> SelfTraining:
    """Return the wrapper, somewhere inside a predictor, that trains several models, each without a part of the samples.

    Raises:
        ConfigError: there is no such wrapper.
    """
    wrapper = self_training(model)
    if wrapper is None or not wrapper.part_count:
        raise ConfigError(
            "uncertainty.conformal.score=cv_plus needs models that each left out a part of the samples, but no wrapper "
            "inside conformal trains such models. Write uncertainty=[folds,conformal], or choose another score."
        )
    return wrapper


def split_in_halves(batches: Sequence[Batch]) -> tuple[list[Batch], list[Batch]]:
    """Return the batches with a random half of the samples, rounded up, and the batches with all other samples.

    Both keep the order of the samples and have no empty batches. The choice depends only on the number of samples. The
    half is random, because a half of every second sample could be biased: in many data sets neighbours alternate
    between classes, or belong together.
    """
    sizes = [len(batch["target"]) for batch in batches]
    order = torch.randperm(sum(sizes), generator=torch.Generator().manual_seed(SEED))
    chosen = torch.zeros(sum(sizes), dtype=torch.bool)
    chosen[order[: (len(order) + 1) // 2]] = True
    parts: tuple[list[Batch], list[Batch]] = ([], [])
    for batch, mask in zip(batches, chosen.split(sizes), strict=True):
        for part, some in zip(parts, (mask, ~mask), strict=True):
            rows = some.nonzero().flatten().to(batch["target"].device)
            if len(rows):
                part.append({name: field[rows] for name, field in batch.items()})
    return parts


def coverage_remark(count: int, miscoverage: float) -> str:
    """Return a remark on how far the coverage may deviate from the stated one, and how many scores keep it within NEAR.

    The threshold is fitted to n = `count` scores of the validation split. The coverage of the sets with this threshold
    is itself random: Beta(k, n + 1 - k) for distinct scores, with k = ⌈(n + 1)(1 - α)⌉ for α = `miscoverage` (Vovk
    2012, prop. 2a). The mean of the coverage over validation splits is k / (n + 1).
    """
    left_out = _left_out(count, miscoverage)
    if not left_out:
        return (
            f"conformal: the threshold is set by {count_of(count, 'validation sample')}, too few: every set holds all "
            f"values. At least {_least(miscoverage)} are needed."
        )
    from scipy.special import betaincinv  # importing SciPy takes longer than most commands need it

    low, high = betaincinv(count + 1 - left_out, left_out, [0.05, 0.95])
    stated = f"{100 * (1 - miscoverage):g} %"
    summary = (
        f"conformal: the threshold is set by {count_of(count, 'validation sample')}. The sets hold {stated} of the "
        "targets on average over validation splits. In nine of ten splits of this size, they hold between "
        f"{100 * low:.3g} and {100 * high:.3g} %"
    )
    if max(high - (1 - miscoverage), 1 - miscoverage - low) <= NEAR:
        return f"{summary}."
    wanted = math.ceil(miscoverage * (1 - miscoverage) * (NINETY / NEAR) ** 2)
    return (
        f"{summary}. With about {wanted:,} samples, this share would be within {100 * NEAR:g} percentage points of "
        f"{stated}."
    )


def _left_out(count: int, miscoverage: float) -> int:
    """Return ⌊(n + 1) α⌋, the number of scores at or above the threshold, for n = `count` and α = `miscoverage`."""
    # α is rounded, so that (n + 1) α may fall just below an integer; the factor corrects that
    return min(count, math.floor((count + 1) * miscoverage * (1 + 1e-12)))


def _least(miscoverage: float) -> int:
    """Return the smallest number n of scores with (n + 1) α ≥ 1, for which the sets do not hold all values."""
    return max(1, math.ceil(1 / miscoverage - 1e-9) - 1)


def threshold(scores: Float[Tensor, "sample"], miscoverage: float) -> float:
    """Return the k-th smallest of n scores, k = ⌈(n + 1)(1 - α)⌉ for α = `miscoverage`; infinite if k > n.

    Source: Vovk, Gammerman & Shafer 2005, §4.1.
    """
    count = len(scores)
    left_out = _left_out(count, miscoverage)  # k is at least 1
    return scores.sort().values[count - left_out].item() if left_out else math.inf


def raise_shared(value: float, scores: Float[Tensor, "sample"], unit: float) -> float:
    """Return a threshold that several scores share, plus an allowance for their rounding; otherwise the threshold.

    Args:
        value: one of the scores, or infinity.
        scores: scores of the validation samples.
        unit: size of typical differences of scores: 1 nat, or the standard deviation of the targets.
    """
    allowance = ROUNDING * max(unit, abs(value)) if math.isfinite(value) else 0.0
    shared = int(((scores - value).abs() <= allowance).sum()) > 1
    return value + allowance if shared else value
