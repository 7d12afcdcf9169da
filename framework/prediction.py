"""What a model predicted for one batch; whatever is derived from it is computed on first use, once."""

import math
from collections.abc import Collection
from contextlib import nullcontext
from functools import cached_property
from typing import Literal

from torch import Size, Tensor
from torch.distributions import Distribution

from framework.data import Batch, Frame
from framework.distributions.circular import wrap
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.intervals import DRAWS, Interval, middle
from framework.distributions.moved import Moved
from framework.distributions.noise import Draw
from framework.distributions.protocol import Estimate, ValueSet, estimate, images, marginal, median
from framework.errors import DataError
from framework.target import Target

Split = Literal["test", "outliers"]
"""Where inputs come from: the test split, or data that belongs to nothing the model was trained on."""


class Prediction:
    """A density over a batch, beside the batch.

    Args:
        density: with batch_shape (batch,).
        batch: the fields of the batch, on the density's device.
        samples: draws for a point prediction that has no closed form (S of eq. 3.24).
        split: where the batch comes from; the targets of outliers mean nothing.
        draw: where noise comes from; None: torch's generators as they stand.
        reads: channels of images that will be asked for, to be drawn together.
    """

    def __init__(
        self,
        density: Distribution,
        batch: Batch,
        samples: int = 1000,
        split: Split = "test",
        draw: Draw | None = None,
        reads: Collection[str] = (),
    ) -> None:
        self.density = density
        self.batch = batch
        self.samples = samples
        self.split: Split = split
        self.reads = frozenset(reads)
        self._given = draw
        self._draw = draw or (lambda purpose: nullcontext())

    def in_frame(self, frame: Frame | None) -> "Prediction":
        """The same prediction in the user's own unit, where `Data.frame` says in which the target lies."""
        if frame is None:
            return self
        density = Moved(self.density, *(part.to(self.batch["input"]) for part in frame))
        return Prediction(density, self.batch, self.samples, self.split, self._given, self.reads)

    @property
    def target(self) -> Tensor:
        return self.batch["target"]

    @property
    def log_prob(self) -> Tensor:
        """Log-likelihood of the targets, (batch,), nats."""
        return self.estimate.log_mean

    @cached_property
    def estimate(self) -> Estimate:
        """The same with its Monte Carlo error and the samples it took: 0 where nothing is drawn, NaN if not known."""
        with self._draw("estimate"):
            return estimate(self.density, self.target)

    @cached_property
    def class_probabilities(self) -> Tensor:
        """Of each class, (batch, class), float64; of a density over anything else a UserError."""
        with self._draw("class probabilities"):
            return class_probabilities(self.density)

    @cached_property
    def entropy(self) -> Tensor:
        """Of each density, (batch,), nats."""
        with self._draw("entropy"):
            return self.density.entropy()

    @cached_property
    def point(self) -> Tensor:
        """The prediction of least expected absolute deviation (eq. 3.23-3.24), shaped like the target."""
        with self._draw("point"):
            return median(self.density, self.samples)

    def interval(self, mass: float, draws: int = DRAWS) -> Interval:
        """The middle `mass` of each real or angle, (batch, number) each (`framework.distributions.intervals`)."""
        with self._draw("interval"):
            return middle(self.density, mass, draws)

    def set_size(self, sets: ValueSet) -> Tensor:
        """Size of the sets that come with the densities, (batch,); where it is drawn, always from the same draws."""
        with self._draw("set"):
            return sets.size()

    def deviation(self, draws: int = 999) -> Tensor:
        """The standard deviation of each real, (batch, number). Where the density does not know its own it is that
        of draws, of a normal density to 2 %: 1 / √(2 draws), the standard error."""
        try:
            return self.density.stddev
        except NotImplementedError:
            with self._draw("deviation"):
                return self.density.sample(Size((draws,))).std(0)

    def marginal(self, index: int) -> Distribution:
        """The density of one number of the target."""
        return self._marginals.setdefault(index, marginal(self.density, index))

    @cached_property
    def _marginals(self) -> dict[int, Distribution]:
        return {}

    def image(self, channel: str) -> Tensor:
        """What the point prediction looks like (`protocol.images`), (batch, height, width[, number]).

        The first channel that is asked for is drawn with all that `reads` names; any other with itself alone.
        """
        if channel not in self._images:
            with self._draw("images"):
                self._images.update(images(self.density, {channel, *self.reads} - self._images.keys()))
        return self._images[channel]

    @cached_property
    def _images(self) -> dict[str, Tensor]:
        return {}

    def true_image(self, channel: str) -> Tensor:
        """The truth, shaped like `image`."""
        return true_image(self.batch, channel)


def true_image(batch: Batch, channel: str) -> Tensor:
    """The batch's field of that name.

    Raises:
        DataError: there is no such field.
    """
    if channel not in batch:
        raise DataError(
            f"The true {channel!r} of every image was asked for, but batches have only {', '.join(batch)}. "
            "Choose data that give it, or leave out the metric that reads it."
        )
    return batch[channel]


def answers(target: Target, prediction: Prediction) -> dict[str, Tensor]:
    """What a table of predictions says, (batch,) each, in the user's names and units; angles in degrees. Of images the
    entropy alone: they stand beside the table."""
    if target.kind == "image":
        found = {}
    elif target.kind == "class":
        shares = prediction.class_probabilities
        found = {f"p_{name}": shares[:, label] for label, name in enumerate(target.names)}
    else:
        found = named(target, prediction.point)
    return {**found, "entropy_nats": prediction.entropy}


def named(target: Target, values: Tensor, of: str = "") -> dict[str, Tensor]:
    """Angles or reals, (batch, number), by their names; `of` says what they are, where it is not the prediction."""
    if target.kind == "angle":
        degrees = wrap(values) * (180 / math.pi)
        return {f"{name}{of}_deg": degrees[:, i] for i, name in enumerate(target.names)}
    return {f"{name}{of}": values[:, i] for i, name in enumerate(target.names)}
