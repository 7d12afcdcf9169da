"""The model of the density pipeline: encoders, one linear layer, a density head."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Generic, TypeVar, final

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.density_head import DensityHead, Fitted
from framework.encoder import Encoder
from framework.errors import ConfigError


class Predictor(nn.Module, ABC):
    """Anything that turns inputs into a density and can be trained; a model or a wrapper around one."""

    description: object = None
    """What the checkpoint of a loaded model says of it; its text is what the model prints as."""

    def __repr__(self) -> str:
        return nn.Module.__repr__(self) if self.description is None else str(self.description)

    @abstractmethod
    def forward(self, inputs: Tensor) -> Distribution:
        """The density over the target for a batch of inputs, with batch_shape (batch,)."""

    @abstractmethod
    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """The training loss per sample, nats."""

    @abstractmethod
    def training_densities(self, inputs: Tensor) -> Distribution:
        """What an objective may shape by gradient: batch_shape (batch,), or (batch, member) where several are trained.

        A model's own density; of a wrapper, those of what it wraps, before anything is mixed or calibrated.
        """

    @abstractmethod
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Fit what is not trained by gradient, on the validation set; called once after training."""


@final
class Model(Predictor):
    """Encoders in a chain, a linear layer to the numbers the head reads, the head.

    A head that is fitted at once (`Fitted`) or `direct` reads the features themselves, flattened, without the linear
    layer.

    Args:
        input_shape: of one sample; needed where there are no encoders.
        beside: for a head with several backbones, the encoders of all but the first.

    Raises:
        ConfigError: the last encoder does not end in a vector, or, before a direct head, in as many numbers as that
            reads; or an encoder learns in front of a head that is fitted at once.
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
                    f"{' and '.join(type(encoder).__name__ for encoder in encoders)} learn. Leave those out."
                )
            if head.size and math.prod(shape) != head.size:
                raise ConfigError(
                    f"{type(head).__name__} reads {head.size:,} numbers a sample, but gets {math.prod(shape):,}, of "
                    f"shape {tuple(shape)}. Set its sizes to those of the data."
                )
            self.projection: nn.Module = nn.Flatten()
        elif head.direct:
            if math.prod(shape) != head.size:
                raise ConfigError(
                    f"The last encoder gives {'×'.join(map(str, shape))} numbers, but {type(head).__name__} reads "
                    f"{head.size:,} as they are. Choose an encoder that gives as many, or change its channels."
                )
            self.projection = nn.Flatten()
        elif beside:
            self.projection = nn.Flatten()
        elif len(shape) == 1:
            self.projection = nn.Linear(shape[0], head.size)
            if encoders and encoders[-1].starts_flat:
                nn.init.zeros_(self.projection.weight)
        else:
            raise ConfigError(
                f"The last encoder ends in features of shape {shape}; wanted a vector. "
                "Append an encoder that flattens, such as `mlp`."
            )
        self.head = head
        self.kept: Kept[Tensor] | None = Kept() if head.direct else None

    def forward(self, inputs: Tensor) -> Distribution:
        return self.head(self.raw(inputs))

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        return self.head.loss(self.raw(inputs), target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self(inputs)

    def raw(self, inputs: Tensor) -> Float[Tensor, "batch size"]:
        """What the head reads."""
        return self._raw(inputs) if self.kept is None else self.kept.of(inputs, self._raw)

    def _raw(self, inputs: Tensor) -> Tensor:
        raw: Tensor = self.projection(self.encoders(inputs))
        return raw

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        pairs = [(self.raw(batch["input"]), batch["target"]) for batch in batches]
        raws, targets = zip(*pairs, strict=True)
        self.head.calibrate(torch.cat(raws), torch.cat(targets))


@final
class Backbones(Encoder):
    """Networks of one architecture with weights of their own, each with a linear layer to its part of the raw numbers.

    Args:
        networks: encoders in a chain, of each.
        sizes: how many numbers each gives.

    Raises:
        ConfigError: they do not end in vectors.
    """

    bibtex = ""

    def __init__(self, networks: Sequence[Sequence[Encoder]], sizes: Sequence[int]) -> None:
        super().__init__()
        shape = networks[0][-1].output_shape if networks[0] else ()
        if len(shape) != 1:
            raise ConfigError(
                f"A head with {len(sizes)} backbones wants encoders that end in a vector; the last one's features are "
                f"of shape {shape}. Append an encoder that flattens, such as `mlp`."
            )
        self.networks = nn.ModuleList(
            nn.Sequential(*network, nn.Linear(shape[0], size))
            for network, size in zip(networks, sizes, strict=True)
        )
        self.vectorises = all(encoder.vectorises for network in networks for encoder in network)
        self.output_shape = (sum(sizes),)

    def forward(self, inputs: Tensor) -> Float[Tensor, "batch size"]:
        return torch.cat([network(inputs) for network in self.networks], 1)


Computed = TypeVar("Computed")


class Kept(Generic[Computed]):
    """What was last computed, and of which tensor, while `one_pass` asks for it."""

    last: tuple[()] | tuple[Tensor, Computed] | None = None

    def of(self, inputs: Tensor, compute: Callable[[Tensor], Computed]) -> Computed:
        if self.last and self.last[0] is inputs:
            return self.last[1]
        found = compute(inputs)
        if self.last is not None:
            self.last = (inputs, found)
        return found


@final
class FrozenFrontEnd(Predictor):
    """A predictor of features that need be computed but once (`Encoder.fixed`), with the encoders that give them.

    So whatever wraps the predictor (several members, many passes) does not compute them again.
    """

    def __init__(self, encoders: Sequence[Encoder], predictor: Predictor) -> None:
        super().__init__()
        self.encoders = nn.Sequential(*encoders)
        self.predictor = predictor
        self.kept: Kept[Tensor] = Kept()

    def features(self, inputs: Tensor) -> Float[Tensor, "batch *features"]:
        """What the predictor reads."""
        return self.kept.of(inputs, self.encoders)

    def forward(self, inputs: Tensor) -> Distribution:
        return self.predictor(self.features(inputs))

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        return self.predictor.loss(self.features(inputs), target)

    def training_densities(self, inputs: Tensor) -> Distribution:
        return self.predictor.training_densities(self.features(inputs))

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        self.predictor.calibrate({**batch, "input": self.features(batch["input"])} for batch in batches)


@contextmanager
def one_pass(predictor: Predictor) -> Iterator[None]:
    """Temporarily computes some numbers of one tensor of inputs once, however often loss and densities are asked.

    These are features that are fixed, the raw numbers of direct heads, whose encoders give images which an objective
    compares as the loss does, and what else a module keeps in `kept`.
    """
    found = (getattr(module, "kept", None) for module in predictor.modules())
    parts = [kept for kept in found if isinstance(kept, Kept)]
    for kept in parts:
        kept.last = ()
    try:
        yield
    finally:
        for kept in parts:
            kept.last = None


def fitted_models(predictor: Predictor) -> list[Model]:
    """Those with such a head, wherever they are wrapped."""
    found = [module for module in predictor.modules() if isinstance(module, Model)]
    return [model for model in found if isinstance(model.head, Fitted)]


def learns(predictor: Predictor) -> bool:
    """Whether it is trained by gradient: it has parameters, and no head that is fitted at once."""
    return not fitted_models(predictor) and any(one.requires_grad for one in predictor.parameters())


def each_alone(values: Float[Tensor, "batch *member"]) -> Float[Tensor, "batch"]:
    """A penalty per sample from that of each member, (batch,) or (batch, member): members train as if alone.

    Its value is the mean over members, so that it compares with that of one model; its gradient is that of the sum, so
    that each member's own gradient is neither divided by their number nor changed by the others.
    """
    if values.dim() == 1:
        return values
    total = values.sum(-1)
    return total + (values.mean(-1) - total).detach()


def of_its_own(values: Float[Tensor, "batch"], members: int) -> Float[Tensor, "batch"]:
    """Penalties of samples each of which one member alone sees: their mean is that over all, and the gradient of that
    mean is in each member the gradient of the mean over its own samples."""
    return members * values - (members - 1) * values.detach()
