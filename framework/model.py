"""The model of the density pipeline: encoders, one linear layer, a density head."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.density_head import DensityHead, Fitted
from framework.encoder import Encoder
from framework.errors import ConfigError


class Predictor(nn.Module, ABC):
    """Base class of everything that returns a density for inputs and can be trained: models and wrappers of models."""

    description: object = None
    """Description of a loaded model, read from its checkpoint; `repr` of the model returns its text."""

    def __repr__(self) -> str:
        return nn.Module.__repr__(self) if self.description is None else str(self.description)

    @abstractmethod
    def forward(self, inputs: Tensor) -> Distribution:
        """Return the density over the target for a batch of inputs, with batch_shape (batch,)."""

    @abstractmethod
    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the training loss per sample, nats."""

    @abstractmethod
    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the densities that an objective may shape by gradient.

        Their batch_shape is (batch,), or (batch, member) if several members are trained. A model returns its own
        density. A wrapper returns the densities of the wrapped models, before it mixes or calibrates them.
        """

    @abstractmethod
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Fit, on the validation split, the parameters that gradients do not train; called once after training."""


@final
class Model(Predictor):
    """A chain of encoders, a linear layer to the raw parameters, and a density head.

    A head that is fitted at once (`Fitted`) reads the flattened features themselves, without the linear layer. A
    `direct` head reads them in the shape that it says (`raw_shape`).

    Args:
        encoders: the encoders, in the order in which they are applied.
        head: the density head.
        input_shape: shape of one sample; needed if there are no encoders.
        beside: for a head with several backbones (`DensityHead.backbones`), the chain of encoders of each backbone but
            the first.

    Raises:
        ConfigError: the last encoder's features are not a vector; or, before a direct head, they are not as many as the
            head reads; or an encoder with trained parameters precedes a head that is fitted at once.
    """

    def __init__(
        self,
        encoders: Sequence[Encoder],
        head: DensityHead,
        input_shape: tuple[int, ...] = (),
        beside: Sequence[Sequence[Encoder]] = (),
    ) -> None:
        super().__init__()
        if beside:
            encoders = [Backbones([encoders, *beside], head.backbones)]
        self.encoders = nn.Sequential(*encoders)
        shape = encoders[-1].output_shape if encoders else input_shape
        if isinstance(head, Fitted):
            if any(True for _ in self.encoders.parameters()):
                raise ConfigError(
                    f"{type(head).__name__} is fitted to all features at once and gives encoders no gradient, but "
                    f"{' and '.join(type(encoder).__name__ for encoder in encoders)} have parameters that must be "
                    "trained. Leave these encoders out."
                )
            if head.size and math.prod(shape) != head.size:
                raise ConfigError(
                    f"{type(head).__name__} reads {head.size:,} numbers per sample, but its input has "
                    f"{math.prod(shape):,} numbers, shape {tuple(shape)}. Set the sizes of the density head to the "
                    "sizes of the data."
                )
            self.projection: nn.Module = nn.Flatten()
        elif head.direct:
            if math.prod(shape) != head.size:
                raise ConfigError(
                    f"The last encoder gives {'×'.join(map(str, shape))} numbers, but {type(head).__name__} reads "
                    f"{head.size:,} numbers without a linear layer in between. Choose an encoder that gives as many, "
                    "or change the channels of the encoder."
                )
            self.projection = _reshaping(tuple(shape), head.raw_shape)
        elif beside:
            self.projection = nn.Flatten()
        elif len(shape) == 1:
            self.projection = nn.Linear(shape[0], head.size)
            if encoders and encoders[-1].starts_flat:
                nn.init.zeros_(self.projection.weight)
        else:
            raise ConfigError(
                f"The last encoder returns features of shape {shape}, but the density head requires a vector. "
                "Append an encoder that flattens, such as `mlp`."
            )
        self.head = head
        self.shared_result: SharedResult[Tensor] | None = SharedResult() if head.direct else None

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the density over the target for a batch of inputs."""
        return self.head(self.raw(inputs))

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the loss of the head per sample, nats."""
        return self.head.loss(self.raw(inputs), target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the density for a batch of inputs; objectives may shape it by gradient."""
        return self(inputs)

    def raw(self, inputs: Tensor) -> Float[Tensor, "batch *raw"]:
        """Return the raw parameters that the head reads, (batch, *raw_shape)."""
        return (
            self._raw(inputs)
            if self.shared_result is None
            else self.shared_result.get_or_compute(inputs, self._raw)
        )

    def _raw(self, inputs: Tensor) -> Tensor:
        raw: Tensor = self.projection(self.encoders(inputs))
        return raw

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the head with the raw parameters and targets of all batches."""
        pairs = [(self.raw(batch["input"]), batch["target"]) for batch in batches]
        raws, targets = zip(*pairs, strict=True)
        self.head.calibrate(torch.cat(raws), torch.cat(targets))


def _reshaping(shape: tuple[int, ...], raw_shape: tuple[int, ...]) -> nn.Module:
    """Return the layer between features of `shape` and a direct head that reads raw parameters of `raw_shape`."""
    if shape == raw_shape:
        return nn.Identity()
    flatten = nn.Flatten()
    return flatten if len(raw_shape) == 1 else nn.Sequential(flatten, nn.Unflatten(1, raw_shape))


@final
class Backbones(Encoder):
    """Networks of one architecture, each with its own weights and a linear layer to its part of the raw parameters.

    Args:
        networks: the chain of encoders of each network.
        sizes: number of raw parameters that each network gives.

    Raises:
        ConfigError: the features of the last encoders are not vectors.
    """

    bibtex = ""

    def __init__(self, networks: Sequence[Sequence[Encoder]], sizes: Sequence[int]) -> None:
        super().__init__()
        shape = networks[0][-1].output_shape if networks[0] else ()
        if len(shape) != 1:
            raise ConfigError(
                f"A density head with {len(sizes)} backbones requires encoders that return a vector, but the last "
                f"encoder returns features of shape {shape}. Append an encoder that flattens, such as `mlp`."
            )
        self.networks = nn.ModuleList(
            nn.Sequential(*network, nn.Linear(shape[0], size))
            for network, size in zip(networks, sizes, strict=True)
        )
        self.vectorises = all(encoder.vectorises for network in networks for encoder in network)
        self.output_shape = (sum(sizes),)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch size"]:
        """Return the raw parameters of all networks, concatenated in order, (batch, size)."""
        return torch.cat([network(inputs) for network in self.networks], 1)


class RawNetwork(nn.Module):
    """Base class of modules other than `Model` that compute raw parameters, such as the stacked members of an ensemble.

    Its results must depend only on its two arguments: the inputs and the number of members. A frozen predictor may
    therefore replace it by code that does not use torch.
    """


Computed = TypeVar("Computed")


class SharedResult(Generic[Computed]):
    """Cache of the last result and of the inputs from which it was computed; empty outside of a block `one_pass`."""

    last: tuple[()] | tuple[Tensor, Computed] | None = None

    def get_or_compute(self, inputs: Tensor, compute: Callable[[Tensor], Computed]) -> Computed:
        """Return `compute(inputs)`, or the cached result if it was computed from the same tensor object."""
        if self.last and self.last[0] is inputs:
            return self.last[1]
        result = compute(inputs)
        if self.last is not None:
            self.last = (inputs, result)
        return result


@final
class FrozenFrontEnd(Predictor):
    """A predictor and the encoders before it whose features need to be computed only once (`Encoder.fixed`).

    Wrappers in the predictor, which have several members or predict several times, do not compute the features again.

    Args:
        encoders: the fixed encoders, in the order in which they are applied.
        predictor: the predictor, which reads their features.
    """

    def __init__(self, encoders: Sequence[Encoder], predictor: Predictor) -> None:
        super().__init__()
        self.encoders = nn.Sequential(*encoders)
        self.predictor = predictor
        self.shared_result: SharedResult[Tensor] = SharedResult()

    def features(self, inputs: Tensor) -> Float[Tensor, "batch *features"]:
        """Return the features that the predictor reads."""
        return self.shared_result.get_or_compute(inputs, self.encoders)

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the predictor's density for the features of a batch of inputs."""
        return self.predictor(self.features(inputs))

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the predictor's training loss per sample, nats."""
        return self.predictor.loss(self.features(inputs), target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the densities of the predictor that an objective may shape by gradient."""
        return self.predictor.training_densities(self.features(inputs))

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate the predictor with the features of all batches."""
        self.predictor.calibrate({**batch, "input": self.features(batch["input"])} for batch in batches)


@contextmanager
def one_pass(predictor: Predictor, caches: Sequence[SharedResult[Any]] | None = None) -> Iterator[None]:
    """Compute shared results only once for each tensor of inputs inside the block.

    Loss and densities of the same inputs then reuse them. The shared results are features without trained parameters
    (`Encoder.fixed`), the raw parameters of heads that read the features themselves (`DensityHead.direct`), and the
    results that other modules keep in an attribute `shared_result`. Raw parameters of a direct head are shared, because
    they are images that are expensive to compute, and an objective reads the same images as the loss.

    Args:
        predictor: the predictor.
        caches: its `shared_results`, if the caller has found them before; to find them takes as long as a few layers.
    """
    caches = shared_results(predictor) if caches is None else caches
    for cache in caches:
        cache.last = ()
    try:
        yield
    finally:
        for cache in caches:
            cache.last = None


def shared_results(predictor: Predictor) -> list[SharedResult[Any]]:
    """Return the caches through which modules of a predictor share results within a block of `one_pass`."""
    candidates = (getattr(module, "shared_result", None) for module in predictor.modules())
    return [cache for cache in candidates if isinstance(cache, SharedResult)]


def fitted_models(predictor: Predictor) -> list[Model]:
    """Return the models whose head is fitted at once (`Fitted`), also those inside wrappers."""
    models = [module for module in predictor.modules() if isinstance(module, Model)]
    return [model for model in models if isinstance(model.head, Fitted)]


def learns(predictor: Predictor) -> bool:
    """Return true if a predictor is trained by gradient.

    It then has parameters that require a gradient, and no head that is fitted at once (`Fitted`).
    """
    return not fitted_models(predictor) and any(
        parameter.requires_grad for parameter in predictor.parameters()
    )


def independent_penalty(values: Float[Tensor, "batch *member"]) -> Float[Tensor, "batch"]:
    """Return one penalty per sample, (batch,), with which each member of an ensemble trains as it would train alone.

    The value is the mean over members, so it is comparable with the penalty of a single model. Its gradient is the
    gradient of the sum over members, so the gradient of a member is neither divided by the number of members nor
    changed by other members.

    Args:
        values: penalties of each sample and member, (batch, member). Penalties of a single model, (batch,), are
            returned unchanged.
    """
    if values.dim() == 1:
        return values
    total = values.sum(-1)
    return total + (values.mean(-1) - total).detach()


def own_sample_penalty(values: Float[Tensor, "batch"], members: int) -> Float[Tensor, "batch"]:
    """Return `values` unchanged, but with gradients multiplied by `members`, the number of members of an ensemble.

    The function is for batches in which each sample is seen by one member only. The gradient of the mean over the whole
    batch is then, for each member, the gradient of the mean over the samples that this member sees.
    """
    return members * values - (members - 1) * values.detach()
