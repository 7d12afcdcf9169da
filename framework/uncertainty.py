"""The contract of an uncertainty wrapper: it turns a predictor into a better calibrated predictor."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch
from framework.density_head import Fitted
from framework.model import FrozenFrontEnd, Predictor


class Uncertainty(Predictor):
    """Base class of wrappers around one predictor, such as ensembles, dropout at test time and temperature.

    A constructor takes `model: Callable[[], Predictor]` before `*`. Each call of `model` builds a new, differently
    initialised copy of the wrapped predictor. The returned densities are mixtures of densities (the Mixture of
    distributions.density), never densities of averaged parameters. A wrapper with a single member returns the numbers
    of this member, to the last bit. Wrappers compose: `uncertainty=[ensemble,temperature]` puts temperature around the
    ensemble.
    """

    group: ClassVar[str] = "uncertainty"
    bibtex: ClassVar[str]
    """Citation of the method: BibTeX entries, or their keys in the `references.bib` of the package; "" for none."""
    knobs: Mapping[str, tuple[int, ...]] = {}
    """Attributes that trade error for run time, each with its useful values in ascending order.

    An example is {"samples": (1, 3, 10, 30)}. They may be set at any time after training. A wrapper without such
    attributes has {}.
    """
    model: Predictor
    """The wrapped predictor; by default `loss`, `training_densities` and `calibrate` are those of this predictor.

    A wrapper of several predictors does not set it, and overrides these methods.
    """
    varies_weights: ClassVar[bool] = False
    """True if predictions need the layers of the wrapped model, because they use other weights than the trained ones.

    A frozen predictor then keeps these layers, instead of computing them by other means than torch.
    """
    remark: str = ""
    """A sentence for the user about the result of `calibrate`; "" if there is nothing to report.

    `calibrate` sets it, runs print it, and checkpoints store it.
    """

    @abstractmethod
    def forward(self, inputs: Tensor) -> Distribution:
        """Return the density over the target for a batch of inputs."""

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the training loss per sample, nats; the default is the loss of `model`."""
        return self.model.loss(inputs, target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the wrapped densities that an objective may shape by gradient; the default is those of `model`.

        Their batch_shape is (batch,) or (batch, member).
        """
        return self.model.training_densities(inputs)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the wrapped predictor, then the wrapper, on the validation split; called once after training.

        The default calibrates `model` alone.
        """
        self.model.calibrate(batches)


class SeveralModels(ABC):
    """Additional base class of a wrapper that trains several models, each as it would train alone.

    Attributes:
        model_count: number of models.
        own_batches: True if `loss` and `training_densities` are given one batch per model, concatenated in the order of
            the models and equally long, and each model sees its own batch only. Densities then have the batch_shape
            (rows of each batch, member). The attribute is True only while training on one device, where each model has
            its own order of samples.
    """

    model_count: int
    own_batches: bool = False

    @abstractmethod
    def clip_each_model(self, max_norm: float) -> None:
        """Scale the gradient of each model down to the norm `max_norm` if its norm is larger."""


class SelfTraining(ABC):
    """Additional base class of a wrapper that trains its models itself, on training and validation split together.

    The wrapper must divide the samples itself, so that each sample can be predicted by models that did not see it.
    Settings of the trainer and the optimiser have no effect, and objectives are refused.

    Attributes:
        rows: for each sample of the next prediction, its number among the samples that trained the models, (batch,);
            the wrapper then predicts the sample by the models that did not see it. None: all models predict. The
            attribute is set by `held_out` only.
        part_count: number of parts of the samples, if each sample belongs to exactly one part, and each model saw a
            part as a whole or not at all; 0 if the wrapper divides the samples in another way.
        left_out: number of a part; all samples of the next prediction are then predicted by the models that did not see
            this part, also after loading. None: `rows` decides.
    """

    rows: Tensor | None = None
    part_count: int = 0
    left_out: int | None = None

    def part_of(self, rows: Int[Tensor, "sample"]) -> Int[Tensor, "sample"]:
        """Return the number of the part to which each sample belongs, (sample,).

        `rows` are the numbers of the samples among those that trained the models. The method is called after
        `train_models` of the same object, and only if `part_count` is above 0.
        """
        raise NotImplementedError

    @abstractmethod
    def train_models(
        self,
        inputs: Float[Tensor, "sample *input"],
        target: Tensor,
        *,
        seed: int,
        batch_size: int,
        most_steps: int | None = None,
    ) -> float:
        """Train and calibrate all models in place, and return the mean loss over all samples, nats.

        For the loss, each sample is predicted by the models that did not see it.

        Args:
            inputs: inputs of the training split, then those of the validation split.
            target: targets of the same samples, (sample, *event).
            seed: seed of random numbers.
            batch_size: number of samples of a training batch of each model.
            most_steps: largest number of training steps of each model, set in a short test run (`debug=fast`); None for
                no limit.
        """


def self_training(predictor: Predictor) -> SelfTraining | None:
    """Return the outermost wrapper that trains its models itself, or None if there is none."""
    return next((module for module in predictor.modules() if isinstance(module, SelfTraining)), None)


@contextmanager
def held_out(predictor: Predictor, batch: Batch) -> Iterator[None]:
    """Let each sample of a batch be predicted, inside the block, by models that were not trained on it.

    The block has an effect only if a wrapper trains its models itself (`SelfTraining`), and the batch has the field
    "row": the number of each sample among the samples that trained the models. The framework adds this field for
    calibration.
    """
    wrapper = self_training(predictor)
    if wrapper is None:
        yield
        return
    wrapper.rows = batch.get("row")
    try:
        yield
    finally:
        wrapper.rows = None


class FollowsTraining(ABC):
    """Additional base class of a wrapper that reads the weights while they are trained, such as an average of weights.

    The wrapper keeps the collected numbers in buffers, so that checkpoints store them, and a resumed training continues
    with them. The weights of the last epoch must be kept (trainer.keep=last), and training must not stop early
    (trainer.patience=null).
    """

    @abstractmethod
    def after_epoch(self, epoch: int, epochs: int) -> None:
        """Read the present weights at the end of a training epoch, before its checkpoint is written.

        Args:
            epoch: number of the epoch, from 0. A resumed training may repeat the epoch of its checkpoint.
            epochs: planned number of epochs.
        """


class ReadsTraining:
    """Additional base class of a wrapper whose `calibrate` reads the training split too, to fit a posterior of weights.

    `calibrate` is still given the validation split. A wrapper that trains its models itself (`SelfTraining`) cannot
    contain such a wrapper, because each of its models has a training split of its own.

    Attributes:
        training_split: batches of the training split without augmentation, which may be iterated repeatedly; set by
            `reading_training` only, while `calibrate` runs. None: `calibrate` has no other samples than those that it
            is given.
    """

    training_split: Iterable[Batch] | None = None


@contextmanager
def reading_training(predictor: Predictor, batches: Iterable[Batch]) -> Iterator[None]:
    """Give the training split to all wrappers that read it (`ReadsTraining`), inside the block.

    Args:
        predictor: the predictor.
        batches: batches of the training split, which may be iterated repeatedly.
    """
    readers = [module for module in predictor.modules() if isinstance(module, ReadsTraining)]
    split = _Features(predictor, batches) if isinstance(predictor, FrozenFrontEnd) else batches
    try:
        for reader in readers:
            reader.training_split = split
        yield
    finally:
        for reader in readers:
            reader.training_split = None


class _Features:
    """Batches whose inputs are the features of a predictor's fixed encoders."""

    def __init__(self, front: FrozenFrontEnd, batches: Iterable[Batch]) -> None:
        self.front = front
        self.batches = batches

    def __iter__(self) -> Iterator[Batch]:
        for batch in self.batches:
            with torch.no_grad():
                features = self.front.features(batch["input"])
            yield {**batch, "input": features}


def remarks(predictor: Predictor) -> tuple[str, ...]:
    """Return the remarks of the wrappers and fitted heads of a predictor, those of the innermost module last."""
    notes = (module.remark for module in predictor.modules() if isinstance(module, Uncertainty | Fitted))
    return tuple(dict.fromkeys(remark for remark in notes if remark))


def outermost(predictor: Predictor) -> SeveralModels | None:
    """Return the outermost wrapper that trains several models, or None if there is none."""
    candidates = (
        module
        for module in predictor.modules()
        if isinstance(module, SeveralModels) and module.model_count > 1
    )
    return next(candidates, None)


def rows_per_model(predictor: Predictor, rows: int) -> int:
    """Return how many of the `rows` samples of a batch each model sees.

    Each model sees all samples, unless a wrapper gives each of its models a part of its own
    (`SeveralModels.own_batches`).
    """
    several = outermost(predictor)
    return rows // several.model_count if several is not None and several.own_batches else rows


@contextmanager
def own_batches(predictor: Predictor, own: bool = True) -> Iterator[None]:
    """Set `SeveralModels.own_batches` of the outermost wrapper of several models to `own` inside the block.

    With True each model sees its own part of a batch; with False each model sees the whole batch.
    """
    several = outermost(predictor)
    if several is None:
        yield
        return
    before, several.own_batches = several.own_batches, own
    try:
        yield
    finally:
        several.own_batches = before


class Joining(ABC):
    """Additional base class of a wrapper whose members can be models that were trained separately (mode=combine)."""

    @classmethod
    @abstractmethod
    def parameters_of(cls, count: int) -> dict[str, Any]:
        """Return the config that builds this wrapper around `count` members, for example {"members": count}."""

    @abstractmethod
    def join(self, members: Sequence[Predictor]) -> None:
        """Take over the weights of the members, in order; each member is built like the wrapped predictor."""
