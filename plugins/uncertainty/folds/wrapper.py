"""Cross-fitted ensembles: models that each leave out one fold, pooled and calibrated on the samples they left out."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Annotated

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.batch_shapes import Stacked
from framework.distributions.density import Mixture
from framework.distributions.noise import seed_step
from framework.distributions.tempering import temper
from framework.errors import ConfigError, UserError
from framework.model import Predictor, independent_penalty
from framework.storage.progress import track_progress
from framework.storage.weights import require_state
from framework.target import Target
from framework.uncertainty import SelfTraining, Uncertainty
from plugins.uncertainty.folds.groups import build_models
from plugins.uncertainty.folds.training import MOST_STEPS, Schedule, Training, assign_folds

Probability = Annotated[float, Field(ge=0, lt=1)]
Decay = Annotated[float, Field(ge=0, allow_inf_nan=False)]
PSEUDO = 2.0
"""Pseudo-count: number of samples that are added for each group when the weights of the groups are fitted."""
EM_STEPS = 200
"""Number of steps of expectation maximisation that fit the weights of the groups; the last steps change little."""
UNLIKELY = 20.0
"""Number of nats below the median log-density at which a left-out sample is reported."""
TEMPERATURES = torch.linspace(0.25, 1.0, 31, dtype=torch.float64)
"""Temperatures at which `fit_model_share` computes likelihoods; between them it interpolates."""
PRIOR = 2.5
"""Weight of the penalty ln² T that `fit_model_share` subtracts, nats; few samples then support no T far from 1."""
LARGEST_SHARE = 0.375
"""Bound of the share of the models, so that the temperature of no pool is below 0.25."""
BLOCK = 4096
"""Number of samples that are predicted at once during calibration."""


class Folds(Uncertainty, SelfTraining):
    """Mixture of models that each leave out one fold of the samples; the left-out samples calibrate the mixture.

    All samples of the training and the validation split are divided into K folds. In each group of K models, model k
    trains on all folds but fold k, keeps its weights of the lowest loss on fold k, and predicts fold k. So each sample
    has a prediction by models that did not see it, as in cross-validation (Stone 1974; stacking, Wolpert 1992). From
    these predictions of all samples, `DensityHead.calibrate` fits what gradients do not train (such as a scale and
    degrees of freedom), and the weights of the groups are fitted by maximum likelihood. A prediction is the mixture of
    all models of all groups.

    The groups differ in dropout and weight decay: tables with much noise need both, and nearly noise-free ones need
    neither. All models of a group train at once by AdamW with half a cosine, as batched matrix products if they consist
    of fully connected layers.

    Each model is calibrated on its own. The mixture of calibrated densities is too wide (Gneiting & Ranjan 2013): the
    errors of the models widen each density, and the mixture adds the differences between the models. For real targets
    and two groups or more, `sharpen` raises the density of each model to the power 1/T, as their spread-adjusted
    linear pool does for normal densities. `pool_temperature` derives T from the weights of the models
    and the share of the models in the variance of the residuals; `fit_model_share` obtains this share from the left-out
    samples. Other mixtures are not narrowed, and a remark says why.

    Args:
        target: the predicted quantity.
        folds: K, the number of folds.
        dropout: probability of all dropout layers in each group; null keeps the probabilities of the encoder.
        weight_decay: weight decay for each group of models.
        learning_rate: largest learning rate.
        steps, epochs: smallest number of steps, and smallest number of passes over its samples, for which each group
            trains.
        sharpen: whether mixtures of several models are narrowed, for real targets and at least two groups.

    Attributes:
        log_weights: logarithms of the weights of the groups, a float64 buffer.
        model_share: share ρ of the models in the variance of the residuals, a float64 buffer; a part of the state only
            if `sharpen` is set, so that states without it, as of earlier versions, load.

    Raises:
        ConfigError: `dropout` and `weight_decay` have different lengths, or the model has no part to train.
    """

    bibtex = "stone1974cross, wolpert1992stacked, seitzer2022pitfalls, gneiting2013combining, krogh1995neural"
    log_weights: Tensor
    model_share: Tensor

    # the settings of the training and of the mixture, each a key of the config
    def __init__(
        self,
        model: Callable[[], Predictor],
        target: Target,
        *,
        folds: Annotated[int, Field(ge=2, le=100)] = 5,
        dropout: list[Probability | None] = [None, 0.0],  # noqa: B006 - never written
        weight_decay: list[Decay] = [0.1, 0.3],  # noqa: B006 - never written
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3,
        steps: Annotated[int, Field(ge=1)] = 3000,
        epochs: Annotated[int, Field(ge=1)] = 45,
        sharpen: bool = False,
    ) -> None:
        super().__init__()
        if len(dropout) != len(weight_decay) or not dropout:
            raise ConfigError(
                f"uncertainty.folds.dropout has {len(dropout)} and weight_decay {len(weight_decay)} numbers, "
                "but each needs one number for each group of models, and at least one group is needed. Give two lists "
                "of the same length."
            )
        self.knobs = {}
        self.folds = self.part_count = folds
        self.schedule = Schedule(steps, epochs, learning_rate, tuple(weight_decay))
        self.models = build_models([model() for _ in range(folds * len(dropout))], dropout)
        if not any(parameter.requires_grad for parameter in self.parameters()):
            raise ConfigError(
                "uncertainty folds trains models by gradient, but this model has nothing to train."
            )
        equal = torch.full((len(dropout),), -math.log(len(dropout)), dtype=torch.float64)
        self.register_buffer("log_weights", equal)
        self.register_buffer("model_share", torch.zeros((), dtype=torch.float64), persistent=sharpen)
        require_state(self, log_weights=(-100.0, 1e-9), model_share=(0.0, LARGEST_SHARE))
        self.sharpen = sharpen
        self._kind = target.kind
        self._sharpened = False
        self.register_load_state_dict_post_hook(lambda module, _: module._note_share())
        self._fold: Tensor | None = None

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the mixture of the densities of all models.

        If `rows`, the row numbers of the inputs in the training data, is set, the mixture for a sample has only the
        models that did not see this sample in training.
        """
        return self._pool(self._groups(inputs))

    def _pool(self, groups: Sequence[Mixture]) -> Distribution:
        """Return the mixture of all models, given one mixture for each group."""
        if len(groups) == 1:
            return groups[0]
        weights = self.log_weights.to(groups[0].log_weights)
        pooled = Mixture(weights.expand(*groups[0].batch_shape, -1), Stacked(groups))
        pooled.over_models = True
        if not self._sharpened:
            return pooled
        models = self.folds if self.rows is None and self.left_out is None else 1
        return temper(pooled, pool_temperature(self.model_share, self.log_weights, models))

    def _note_share(self) -> None:
        """Note whether mixtures are narrowed, because an exported program cannot read it from the buffer."""
        self._sharpened = bool(self.model_share > 0)

    def _groups(self, inputs: Tensor) -> list[Mixture]:
        """Return one mixture for each group, of the densities of its K models, batch_shape (batch,)."""
        mixtures = []
        for components in self.models.densities(inputs):
            like = next(self.parameters())
            dtype = like.dtype if like.dtype.itemsize >= 4 else torch.float32
            log_weights = torch.zeros(components.batch_shape, dtype=dtype, device=like.device)
            fold = self._left_out_fold(components.batch_shape[0])
            if fold is not None:
                fold = fold.to(like.device)
                log_weights.fill_(-math.inf).scatter_(1, fold.unsqueeze(1), 0.0)
            mixtures.append(Mixture(log_weights, components))
            mixtures[-1].over_models = True
        return mixtures

    def _left_out_fold(self, count: int) -> Int[Tensor, "sample"] | None:
        """Return, for each sample of the next prediction, the fold that its models left out; None for all models."""
        if self.left_out is not None:
            return torch.full((count,), self.left_out)
        return None if self.rows is None else self.part_of(self.rows)

    def part_of(self, rows: Int[Tensor, "sample"]) -> Int[Tensor, "sample"]:
        """Return the fold of each sample; `rows` are row numbers in the data that `train_models` read."""
        assert self._fold is not None
        return self._fold[rows.cpu()]

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the mean loss of all models for each sample, nats.

        The gradient is that of the sum over the models instead of their mean, so each model trains as it would alone.
        """
        return independent_penalty(self.models.losses_of_all(inputs, target))

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the densities of all models, batch_shape (batch, member)."""
        return Stacked(self.models.training_densities(inputs))

    def train_models(
        self,
        inputs: Float[Tensor, "sample *input"],
        target: Tensor,
        *,
        seed: int,
        batch_size: int,
        most_steps: int | None = None,
    ) -> float:
        """Train and calibrate all models.

        Args:
            inputs: inputs of all samples.
            target: targets of all samples.
            seed: seed of the folds and of the training.
            batch_size: number of samples of a batch of each model.
            most_steps: largest number of steps; None for MOST_STEPS.

        Returns:
            Mean loss of the samples, each predicted by models that did not see it, nats.

        Raises:
            ConfigError: there are fewer than two samples per fold.
        """
        if len(inputs) < 2 * self.folds:
            raise ConfigError(
                f"uncertainty.folds.folds = {self.folds} needs at least {2 * self.folds} samples for training and "
                f"validation together, but there are {len(inputs)}. Lower the number of folds."
            )
        devices = [inputs.device] if inputs.is_cuda else []
        with torch.random.fork_rng(devices), torch.enable_grad():
            seed_step(seed, 0, "folds")
            self._fold = assign_folds(inputs.cpu(), self.folds)
            self.train()
            schedule = replace(
                self.schedule, batch_size=batch_size, most_steps=min(MOST_STEPS, most_steps or MOST_STEPS)
            )
            training = Training(self.models, inputs, target, self._fold, self.folds, schedule)
            for _ in track_progress(training, "training", len(training), "steps"):
                pass
            self.eval()
        return self._calibrate_held_out(inputs, target)

    @torch.no_grad()
    def _calibrate_held_out(self, inputs: Tensor, target: Tensor) -> float:
        """Calibrate the heads and the weights of the groups, and return the mean loss of all samples, nats.

        `inputs` and `target` are the samples of the training; models that did not see a sample predict it.
        """
        assert self._fold is not None
        rows = torch.arange(len(inputs)).split(BLOCK)
        batches: list[Batch] = [{"input": inputs[part], "target": target[part]} for part in rows]
        self.models.calibrate(batches, [self._fold[part] for part in rows])
        groups, parts = [], []
        self.model_share.zero_()
        self._note_share()
        try:
            for self.rows, batch in zip(rows, batches, strict=True):
                groups.append(self._groups(batch["input"]))
            log_prob = torch.cat([log_prob_of_groups(*pair) for pair in zip(groups, batches, strict=True)])
            self.log_weights.copy_(fit_log_weights(log_prob))
            note = self._fit_share(groups, batches) if self.sharpen else ""
            self._note_share()
            for several, batch in zip(groups, batches, strict=True):
                parts.append(self._pool(several).log_prob(batch["target"]).double())
        finally:
            self.rows = None
        pooled = torch.cat(parts)
        if self.sharpen and not note:
            temperature = pool_temperature(self.model_share, self.log_weights, self.folds).item()
            note = f" The mixture of all models has the temperature {temperature:.2f}."
        self.remark = describe(pooled, self.log_weights) + note
        return -pooled.mean().item()

    def _fit_share(self, groups: Sequence[Sequence[Distribution]], batches: Sequence[Batch]) -> str:
        """Fit `model_share` to left-out samples, and return a note if the mixture cannot be narrowed."""
        obstacle = ""
        if self._kind != "real":
            obstacle = f"its target is of kind {self._kind}, not real"
        elif len(self.log_weights) == 1:
            obstacle = "uncertainty.folds.dropout has one group of models, and two are needed"
        else:
            try:
                self.model_share.fill_(fit_model_share(groups, batches))
            except UserError:
                obstacle = "the powers of its densities are not known"
        return obstacle and f" The mixture is not narrowed (uncertainty.folds.sharpen), because {obstacle}."

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the models with samples that no model saw in training.

        Samples of the training have the field "row". For them the method does nothing, because `train_models` has
        already calibrated the models with them.
        """
        calibration_batches = list(batches)
        if not any("row" in batch for batch in calibration_batches):
            self.models.calibrate(calibration_batches, None)


def log_prob_of_groups(groups: Sequence[Distribution], batch: Batch) -> Float[Tensor, "sample group"]:
    """Return the log-densities of a batch's targets by the density of each group, nats, float64."""
    return torch.stack([group.log_prob(batch["target"]).double() for group in groups], 1)


def pool_temperature(
    model_share: Float[Tensor, ""], log_weights: Float[Tensor, "group"], models: int
) -> Float[Tensor, ""]:
    """Return the temperature T = 1 - 2ρ (1 - Σ_j w_j²) of the densities in a mixture of calibrated models.

    Let the error of model j be e - δ_j, with independent δ_j of mean 0 and variance d², and an error e that all models
    share. A calibrated density of one model has the variance e² + d², of which d² is the share ρ. With the weights w_j,
    the squared error of the mixture's mean is e² + d² Σ w_j² on average. The variance of the mixture is the mean
    variance of its densities plus d² (1 - Σ w_j²), the mean squared difference between the models and their mean
    (Krogh & Vedelsby 1995, eq. 6). The two are equal if the variance of each density is multiplied by T. The power 1/T
    of a normal density has this variance. One model alone has T = 1.

    Args:
        model_share: ρ, between 0 and LARGEST_SHARE.
        log_weights: logarithms of the weights of the groups.
        models: number of models of each group, which have equal weights.
    """
    return 1 - 2 * model_share * (1 - (2 * log_weights).exp().sum() / models)


def fit_model_share(groups: Sequence[Sequence[Distribution]], batches: Sequence[Batch]) -> float:
    """Return the share ρ of the models in the variance of the residuals, from samples that the models left out.

    Let T_1 be the temperature at which the densities of single models have the highest penalised likelihood, and T_G
    that of the equal mixture of one model of each of the G groups. T_1 is near 1 if the models are calibrated. By
    `pool_temperature`, T_G/T_1 is 1 - 2ρ (1 - 1/G), from which ρ follows. Errors that all models of a fold share,
    because they trained on the same samples, count as errors that all models share, so that ρ is rather too small.

    Args:
        groups: for each batch, the density of each group by a model that left the samples out; at least two groups.
        batches: the samples.

    Raises:
        UserError: the powers of the densities are not known.
    """
    number = len(groups[0])
    single, mixed = (-PRIOR * TEMPERATURES.log().square() for _ in range(2))
    for several, batch in zip(groups, batches, strict=True):
        for index, temperature in enumerate(TEMPERATURES):
            log_prob = log_prob_of_groups([temper(group, temperature) for group in several], batch)
            single[index] += log_prob.mean(1).sum().cpu()
            mixed[index] += torch.logsumexp(log_prob, 1).sum().cpu()
    ratio = _highest(mixed) / _highest(single)
    return min(max(1 - ratio, 0.0) / (2 * (1 - 1 / number)), LARGEST_SHARE)


def _highest(totals: Float[Tensor, "temperature"]) -> float:
    """Return the temperature of the highest likelihood: the vertex of the parabola through the three best points.

    Args:
        totals: likelihood at each of TEMPERATURES.
    """
    best = int(totals.nan_to_num(nan=-math.inf).argmax())
    if best in (0, len(totals) - 1):
        return TEMPERATURES[best].item()
    before, largest, after = totals[best - 1 : best + 2].tolist()
    curvature = 2 * largest - before - after
    step = (TEMPERATURES[1] - TEMPERATURES[0]).item()
    offset = (after - before) / (2 * curvature) if curvature > 0 else 0.0
    return TEMPERATURES[best].item() + step * offset


def fit_log_weights(log_prob: Float[Tensor, "sample group"]) -> Float[Tensor, "group"]:
    """Return the logarithms of the weights of highest likelihood, by expectation maximisation, float64.

    The fit counts PSEUDO additional samples for each group, so that no weight is 0.

    Args:
        log_prob: log-densities of the samples by each group, nats.
    """
    count, groups = log_prob.shape
    log_weights = log_prob.new_full((groups,), -math.log(groups))
    known = log_prob.clamp(min=-1e6)  # all groups may give a sample the density 0
    for _ in range(EM_STEPS):
        share = torch.softmax(known + log_weights, 1).sum(0) + PSEUDO
        log_weights = (share / (count + PSEUDO * groups)).log()
    return log_weights


def describe(pooled: Float[Tensor, "sample"], log_weights: Float[Tensor, "group"]) -> str:
    """Return a remark on the fitted weights, and on left-out samples that are nearly impossible.

    Args:
        pooled: log-densities of the samples by models that did not see them, nats.
        log_weights: logarithms of the weights of the groups.
    """
    weights = ", ".join(f"{weight:.2f}" for weight in log_weights.exp().tolist())
    text = (
        f"folds: log-likelihood {pooled.mean():.4g} nats of {len(pooled)} samples by models that did not see them; "
        f"weights of the groups {weights}."
    )
    below = torch.nonzero(pooled < pooled.median() - UNLIKELY).flatten()
    if len(below) == 0:
        return text
    worst = int(pooled.argmin())
    return (
        f"{text} {len(below)} of these samples are more than {UNLIKELY:g} nats less likely than the median; the least "
        f"likely is sample {worst} of training and validation together, with {pooled[worst]:.3g} nats. Check these "
        "samples for errors; if they are right, the targets have heavier tails than the density head allows."
    )
