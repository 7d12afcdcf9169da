"""Cross-fitted ensembles: models that each leave out one fold, pooled and calibrated on the samples they left out."""

import math
from collections.abc import Callable, Iterable
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
from framework.errors import ConfigError
from framework.model import Predictor, independent_penalty
from framework.storage.progress import track_progress
from framework.storage.weights import require_state
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

    Args:
        folds: K, the number of folds.
        dropout: probability of all dropout layers in each group; null keeps the probabilities of the encoder.
        weight_decay: weight decay for each group of models.
        learning_rate: largest learning rate.
        steps, epochs: smallest number of steps, and smallest number of passes over its samples, for which each group
            trains.

    Attributes:
        log_weights: logarithms of the weights of the groups, a float64 buffer.

    Raises:
        ConfigError: `dropout` and `weight_decay` have different lengths, or the model has no part to train.
    """

    bibtex = "stone1974cross, wolpert1992stacked, seitzer2022pitfalls"
    log_weights: Tensor

    def __init__(
        self,
        model: Callable[[], Predictor],
        *,
        folds: Annotated[int, Field(ge=2, le=100)] = 5,
        dropout: list[Probability | None] = [None, 0.0],  # noqa: B006 - never written
        weight_decay: list[Decay] = [0.1, 0.3],  # noqa: B006 - never written
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 3e-3,
        steps: Annotated[int, Field(ge=1)] = 3000,
        epochs: Annotated[int, Field(ge=1)] = 45,
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
        require_state(self, log_weights=(-100.0, 1e-9))
        self._fold: Tensor | None = None

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the mixture of the densities of all models.

        If `rows`, the row numbers of the inputs in the training data, is set, the mixture for a sample has only the
        models that did not see this sample in training.
        """
        groups = self._groups(inputs)
        if len(groups) == 1:
            return groups[0]
        weights = self.log_weights.to(groups[0].log_weights)
        pooled = Mixture(weights.expand(*groups[0].batch_shape, -1), Stacked(groups))
        pooled.over_models = True
        return pooled

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
        parts = []
        try:
            for self.rows, batch in zip(rows, batches, strict=True):
                groups = self._groups(batch["input"])
                parts.append(torch.stack([group.log_prob(batch["target"]).double() for group in groups], 1))
        finally:
            self.rows = None
        log_prob = torch.cat(parts)
        self.log_weights.copy_(fit_log_weights(log_prob))
        pooled = torch.logsumexp(log_prob + self.log_weights, 1)
        self.remark = describe(pooled, self.log_weights)
        return -pooled.mean().item()

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the models with samples that no model saw in training.

        Samples of the training have the field "row". For them the method does nothing, because `train_models` has
        already calibrated the models with them.
        """
        calibration_batches = list(batches)
        if not any("row" in batch for batch in calibration_batches):
            self.models.calibrate(calibration_batches, None)


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
