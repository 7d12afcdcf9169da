"""Prediction of a model for one batch; every quantity derived from it is computed once, at first use."""

import math
from collections.abc import Collection
from contextlib import nullcontext
from functools import cached_property
from typing import Literal

from torch import Size, Tensor
from torch.distributions import Distribution

from framework.data import Batch, Frame
from framework.distributions.affine import AffineDensity
from framework.distributions.circular import wrap
from framework.distributions.class_probabilities import class_probabilities
from framework.distributions.intervals import DRAWS, Interval, central_interval
from framework.distributions.noise import Draw
from framework.distributions.protocol import Estimate, ValueSet, estimate, images, marginal, median
from framework.distributions.unchanged import outlier_score
from framework.errors import DataError
from framework.target import Target

Split = Literal["test", "outliers"]
"""Source of the inputs: the test split, or outliers, which are of a kind that training did not show."""


class Prediction:
    """A batch and the density that is predicted for it.

    Args:
        density: predicted density of each sample, with batch_shape (batch,).
        batch: the fields of the batch, on the density's device.
        samples: number of samples for a point prediction that has no closed form (S of thesis eq. 3.24).
        split: "test" for a batch of the test split, "outliers" for a batch of outliers, whose targets have no meaning.
        draw: source of random numbers; None uses the current state of torch's generators.
        reads: channels of images that will be requested, so that they are drawn together.
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
        self._noise_source = draw
        self._draw = draw or (lambda purpose: nullcontext())

    def in_frame(self, frame: Frame | None) -> "Prediction":
        """Return this prediction in the user's unit, given the `Data.frame` of its targets; None changes nothing."""
        if frame is None:
            return self
        density = AffineDensity(self.density, *(part.to(self.batch["input"]) for part in frame))
        return Prediction(density, self.batch, self.samples, self.split, self._noise_source, self.reads)

    @property
    def target(self) -> Tensor:
        """Targets of the batch, (batch, *event)."""
        return self.batch["target"]

    @property
    def log_prob(self) -> Tensor:
        """Log-likelihood of the targets, (batch,), nats."""
        return self.estimate.log_mean

    @cached_property
    def estimate(self) -> Estimate:
        """Log-likelihood of the targets with its Monte Carlo error and number of samples.

        The Monte Carlo error is a standard error, nats. It is 0 if log_prob draws no samples, and NaN if it is not
        known.
        """
        with self._draw("estimate"):
            return estimate(self.density, self.target)

    @cached_property
    def class_probabilities(self) -> Tensor:
        """Probability of each class, (batch, class), float64; a density over any other target raises a UserError."""
        with self._draw("class probabilities"):
            return class_probabilities(self.density)

    @cached_property
    def entropy(self) -> Tensor:
        """Entropy of each density, (batch,), nats."""
        with self._draw("entropy"):
            return self.density.entropy()

    @cached_property
    def point(self) -> Tensor:
        """Point prediction, shaped like the target: the value of smallest expected absolute deviation.

        For classes it is the most likely class. The source is thesis eq. 3.23-3.24.
        """
        with self._draw("point"):
            return median(self.density, self.samples)

    def interval(self, mass: float, draws: int = DRAWS) -> Interval:
        """Return the central interval of probability `mass` of each real or angle, with ends of shape (batch, number).

        `framework.distributions.intervals.central_interval` computes it, from `draws` draws if there is no closed form.
        """
        with self._draw("interval"):
            return central_interval(self.density, mass, draws)

    def set_size(self, sets: ValueSet) -> Tensor:
        """Return the sizes of the prediction sets, (batch,).

        A size that is estimated from draws always uses the same draws.
        """
        with self._draw("set"):
            return sets.size()

    def deviation(self, draws: int = 999) -> Tensor:
        """Return the standard deviation of each real, (batch, number).

        If a density has no formula for its standard deviation, it is estimated from `draws` samples. For a normal
        density the relative standard error of this estimate is 1 / √(2 draws), which is 2 % by default.
        """
        try:
            return self.density.stddev
        except NotImplementedError:
            with self._draw("deviation"):
                return self.density.sample(Size((draws,))).std(0)

    def marginal(self, index: int) -> Distribution:
        """Return the marginal density of one number of the target, whose position in the target is `index`."""
        return self._marginals.setdefault(index, marginal(self.density, index))

    @cached_property
    def _marginals(self) -> dict[int, Distribution]:
        return {}

    def image(self, channel: str) -> Tensor:
        """Return a channel of the images of the point predictions, (batch, height, width[, number]).

        `protocol.images` draws them. The first request draws its channel together with all channels in `reads`. A later
        request for another channel draws that channel only.
        """
        if channel not in self._images:
            with self._draw("images"):
                self._images.update(images(self.density, {channel, *self.reads} - self._images.keys()))
        return self._images[channel]

    @cached_property
    def _images(self) -> dict[str, Tensor]:
        return {}

    def true_image(self, channel: str) -> Tensor:
        """Return the true image of a channel, shaped like the result of `image`."""
        return true_image(self.batch, channel)


def true_image(batch: Batch, channel: str) -> Tensor:
    """Return the batch's field of the name `channel`.

    Raises:
        DataError: there is no such field.
    """
    if channel not in batch:
        raise DataError(
            f"A metric reads the true {channel!r} of every image, but the batches have only {', '.join(batch)}. "
            f"Choose data that have {channel!r}, or leave out the metric."
        )
    return batch[channel]


def table_columns(target: Target, prediction: Prediction) -> dict[str, Tensor]:
    """Return the columns of a table of predictions, (batch,) each, in the user's names and units; angles in degrees.

    For images it returns no point prediction, because images are stored beside the table. Densities with an outlier
    score (`framework.distributions.unchanged`) have a column for it.
    """
    if target.kind == "image":
        columns = {}
    elif target.kind == "class":
        shares = prediction.class_probabilities
        columns = {f"p_{name}": shares[:, label] for label, name in enumerate(target.names)}
    else:
        columns = named_columns(target, prediction.point)
    columns = {**columns, "entropy_nats": prediction.entropy}
    score = outlier_score(prediction.density)
    return columns if score is None else {**columns, "outlier_score": score}


def named_columns(target: Target, values: Tensor, of: str = "") -> dict[str, Tensor]:
    """Return angles (in degrees) or reals, (batch, number), as columns by name.

    `of` is appended to each name, to say what the values are; "" for the predictions themselves.
    """
    if target.kind == "angle":
        degrees = wrap(values) * (180 / math.pi)
        return {f"{name}{of}_deg": degrees[:, i] for i, name in enumerate(target.names)}
    return {f"{name}{of}": values[:, i] for i, name in enumerate(target.names)}
