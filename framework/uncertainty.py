"""The contract of an uncertainty wrapper: a predictor in, a better calibrated predictor out."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch
from framework.model import Predictor


class Uncertainty(Predictor):
    """Wraps one predictor: ensemble, dropout at test time, temperature and the like.

    A constructor asks for `model: Callable[[], Predictor]` before `*`, which builds a fresh, differently initialised
    copy of what is wrapped at each call. The densities it returns are mixtures of densities (the Mixture of
    distributions.density), never densities of averaged parameters; wrapping one member gives that member's numbers to
    the last bit. They compose: `uncertainty=[ensemble,temperature]` puts temperature around the ensemble.
    """

    group: ClassVar[str] = "uncertainty"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""
    knobs: Mapping[str, tuple[int, ...]] = {}
    """Attributes that trade error for run time and may be set at any time after training, with the values worth
    trying, ascending: {"samples": (1, 3, 10, 30)}. Empty where there is none."""
    remark: str = ""
    """What `calibrate` found that whoever uses the model should know, a sentence that it sets; runs print it, and it
    travels with the model. "" where there is nothing to say."""

    @abstractmethod
    def forward(self, inputs: Tensor) -> Distribution:
        """The density over the target for a batch of inputs."""

    @abstractmethod
    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """The training loss per sample, nats."""

    @abstractmethod
    def training_densities(self, inputs: Tensor) -> Distribution:
        """What an objective may shape by gradient: of what is wrapped, batch_shape (batch,) or (batch, member)."""

    @abstractmethod
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate what is wrapped, then itself, on the validation set; called once after training."""


class Several(ABC):
    """What a wrapper derives from as well when it trains several models, each as it would train alone.

    Attributes:
        trained: how many.
        own_batches: whether `loss` and `training_densities` are given the batches of all of them one after the other,
            equally many rows each, and each sees its own alone; densities have the batch_shape (rows of each, member).
            Set while training on one device, where each then has an order of its own.
    """

    trained: int
    own_batches: bool = False

    @abstractmethod
    def clip_each(self, most: float) -> None:
        """Shorten the gradient of each to the norm `most` where it is longer."""


def remarks(predictor: Predictor) -> tuple[str, ...]:
    """What its wrappers found when they were calibrated, the innermost last."""
    found = (one.remark for one in predictor.modules() if isinstance(one, Uncertainty))
    return tuple(dict.fromkeys(remark for remark in found if remark))


def outermost(predictor: Predictor) -> Several | None:
    """The wrapper that trains several models, of nested ones the outer; None where there is none."""
    found = (one for one in predictor.modules() if isinstance(one, Several) and one.trained > 1)
    return next(found, None)


def rows_each(predictor: Predictor, rows: int) -> int:
    """How many rows of a batch each model sees."""
    several = outermost(predictor)
    return rows // several.trained if several is not None and several.own_batches else rows


@contextmanager
def own_batches(predictor: Predictor, own: bool = True) -> Iterator[None]:
    """Temporarily lets each of several models read its own part of a batch (`Several.own_batches`), or all read all."""
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
    """What a wrapper derives from as well when models that were trained apart can become its members (mode=combine)."""

    @classmethod
    @abstractmethod
    def parameters_of(cls, count: int) -> dict[str, Any]:
        """The config that builds such a wrapper around `count` members: {"members": count}, say."""

    @abstractmethod
    def join(self, members: Sequence[Predictor]) -> None:
        """Take over their weights, in order; each is built like what is wrapped."""
